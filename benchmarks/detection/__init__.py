"""AstraTag against other markers on equal scenes: recall, corners, wrong identities, false accepts and CPU time.

``python -m benchmarks.detection`` runs all of it, in some half an hour of two free cores; ``--images 8 --only
tilt,size`` a part.  The peers come with ``make setup EXTRAS=peers``; those that are not installed are left out.

What makes it unequal, so that the numbers are read rightly: AstraTag is given the camera, its transfer curve (most of
the others' 0.4 px of corner error is what the curve does to dark squares) and, unless it says otherwise, the surface.
The peers run as shipped, with one thread and ArUco's sub-pixel corners; none of them can be told those things.
"""
