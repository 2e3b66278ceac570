"""The pipeline without sockets: the step of each node, estimation, recordings, replay and scoring."""
