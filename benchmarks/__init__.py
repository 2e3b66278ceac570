"""Benchmarks: anyone can run them; each says what it ran on."""
