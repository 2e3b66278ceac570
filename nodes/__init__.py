"""Processes: thin shells that bind a step to the bus, the supervisor and the command line."""

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1")
"""Environment of every process of ours: nodes are parallel by being processes, and the last bits of a sum depend
on how many threads added it up, so that replays are identical only with as many."""
