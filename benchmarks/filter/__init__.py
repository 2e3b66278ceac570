"""How accurate, how honest and how fast the pose filter is, on simulated corners; ``python -m benchmarks.filter``."""
