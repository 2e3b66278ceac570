"""The processes, one table: what each consumes and publishes, and whether a run can do without it."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.steps import STEPS
from schemas import TOPICS, Topic
from schemas.topics import CALIBRATION, CHASER_MOTION, FRAME, GUIDANCE, HEALTH, STATE, TRUTH


@dataclass(frozen=True)
class Process:
    """One row of the table.

    ``required``: a replay ends with an error when it dies; an optional one is merely missed.  In a live run
    either is started again.  ``keeps_all``: it takes every frame of a live run too, however late, where others
    skip to the newest.
    """

    name: str
    consumes: tuple[Topic, ...]
    publishes: tuple[Topic, ...]
    required: bool = True
    keeps_all: bool = False

    @property
    def paced_by(self) -> tuple[Topic, ...]:
        """The topics of which it must have seen a frame's message to have dealt with that frame."""
        return tuple(topic for topic in self.consumes if topic.per_frame)


_RECORDED = tuple(topic for topic in TOPICS if topic.recorded)

PROCESSES = (
    Process("source", (), (CALIBRATION, TRUTH, FRAME, GUIDANCE, CHASER_MOTION)),
    *(Process(spec.name, spec.consumes, spec.produces) for spec in STEPS),
    Process("recorder", _RECORDED, (), keeps_all=True),
    Process("viewer", _RECORDED, (), required=False),
)
"""In the order of the data: each process consumes only what those before it publish, and everybody's health."""

RELAY = Process("relay", (STATE,), (), required=False)
"""Not part of a run: the user starts one beside it for each consumer that is not on the bus."""


def process_named(name: str) -> Process:
    """Return a row of the table.  Raises ValueError for a name that is not in it."""
    everything = (*PROCESSES, RELAY)
    for process in everything:
        if process.name == name:
            return process
    raise ValueError(f"there is no node {name!r}; the nodes are {', '.join(p.name for p in everything)}")


def producers(process: Process) -> tuple[Process, ...]:
    """Return the processes whose topics it consumes."""
    return tuple(other for other in PROCESSES if set(other.publishes) & set(process.consumes) - {HEALTH})


def consumers(process: Process) -> tuple[Process, ...]:
    """Return the processes that consume its topics."""
    return tuple(other for other in PROCESSES if process in producers(other))
