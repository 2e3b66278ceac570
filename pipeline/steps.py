"""The pipeline's steps, one table: what each consumes, what it produces, and how it is built.

A step knows no clock, socket or file: the same object runs behind the bus, in direct replay and in tests.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from pipeline.mission import Mission
from schemas import Envelope, Topic
from schemas.codec import AnyMessage
from schemas.topics import ANNOTATIONS, CALIBRATION, CHASER_MOTION, DETECTIONS, EVENTS, FRAME, STATE, TRANSFORMS


class Step(Protocol):
    """A node's work on one message."""

    def step(self, message: AnyMessage) -> Iterable[AnyMessage]:
        """Take one message and return what follows from it, in order.  Raises ValueError when it cannot be used."""
        ...

    def refused(self, t_capture_ns: int) -> Iterable[AnyMessage]:
        """Return what follows from a frame whose message could not be used: everybody hears of every frame."""
        ...


class Sink(Protocol):
    """Something that keeps or shows what passes: the recorder, the viewer."""

    def write(self, envelope: Envelope, t_receipt_ns: int) -> None:
        """Take one envelope, received at UTC ``t_receipt_ns``."""
        ...

    def close(self) -> None:
        """Finish: nothing taken so far may be lost."""
        ...


@dataclass(frozen=True)
class StepSpec:
    """One row of the table."""

    name: str
    consumes: tuple[Topic, ...]
    produces: tuple[Topic, ...]
    build: Callable[[Mission], Step]


def _detector(mission: Mission) -> Step:
    from pipeline.detector import DetectorStep

    return DetectorStep(mission)


def _pose_filter(mission: Mission) -> Step:
    from pipeline.pose_filter import PoseFilter

    return PoseFilter(mission)


# Imported when built: each process loads only its own step's libraries.
STEPS = (
    StepSpec("detector", (CALIBRATION, FRAME), (DETECTIONS, ANNOTATIONS), _detector),
    StepSpec("pose_filter", (CALIBRATION, DETECTIONS, CHASER_MOTION), (STATE, TRANSFORMS, EVENTS), _pose_filter),
)
