"""Processes: thin shells that bind a step to the bus, the supervisor and the command line."""
