"""AstraTag against other markers on equal scenes: recall, corners, wrong identities, false accepts and CPU time.

``python -m benchmarks.detection`` runs all of it; ``--images 8 --only tilt,size`` a part.
"""
