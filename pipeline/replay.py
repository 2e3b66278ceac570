"""Direct replay: the pipeline's steps in one process, with the messages and their order as on the bus."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

from google.protobuf.json_format import MessageToDict

from pipeline.convert import NS_PER_S
from pipeline.recording import Recording
from pipeline.source import Source
from pipeline.steps import STEPS, Sink, Step, StepSpec
from schemas import CodecError, Envelope, Message, Topic
from schemas.topics import ANNOTATIONS, DETECTIONS, EVENTS, FRAME, STATE, TRANSFORMS

Speed = float | Literal["max"]
REPEATABLE = (DETECTIONS, ANNOTATIONS, STATE, TRANSFORMS, EVENTS)
"""What two replays of one recording give byte for byte."""


@dataclass
class ReplayCounts:
    """What a replay did."""

    frames: int = 0
    refused: int = 0
    """Messages that a step could not handle: damaged, or images that cannot be decoded."""


def replay_direct(
    source: Source,
    sinks: Sequence[Sink],
    *,
    speed: Speed = "max",
    on_frame: Callable[[Envelope], None] | None = None,
    on_refused: Callable[[str], None] = lambda reason: None,
    steps: Sequence[StepSpec] = STEPS,
) -> ReplayCounts:
    """Run a source through the steps into the sinks, and back to the source, which may fly on it.

    ``on_frame`` is called when a frame is through, ``on_refused`` with the reason when a step cannot use a message.
    ``speed`` is a multiple of the recorded pace.  The sinks stay open: they are the caller's.
    """
    counts = ReplayCounts()

    def refuse(reason: str) -> None:
        counts.refused += 1
        on_refused(reason)

    every_sink: tuple[Sink, ...] = (*sinks, source)
    built = [(spec, spec.build(source.mission)) for spec in steps]
    for envelope in paced(source.envelopes(), speed):
        entered = replace(envelope, stamp=replace(envelope.stamp, t_origin_ns=time.time_ns()))
        queue = deque([entered])
        while queue:
            current = queue.popleft()
            for sink in every_sink:
                try:
                    sink.write(current, time.time_ns())
                except CodecError as error:
                    on_refused(f"{type(sink).__name__.lower()} refused {current.topic.name}: {error}")
            queue.extend(_answers(current, built, source, refuse))
        if envelope.topic is FRAME:
            counts.frames += 1
            if on_frame is not None:
                on_frame(entered)
    return counts


def _answers(
    envelope: Envelope, built: Iterable[tuple[StepSpec, Step]], source: Source, refuse: Callable[[str], None]
) -> Iterator[Envelope]:
    """Yield what the steps that consume an envelope make of it, or of its frame when they refuse it."""
    for spec, step in built:
        if envelope.topic not in spec.consumes:
            continue
        try:
            messages = list(step.step(envelope.message()))
        except ValueError as error:
            refuse(f"{spec.name} refused {envelope.topic.name} {envelope.stamp.sequence}: {error}")
            messages = list(step.refused(envelope.stamp.t_capture_ns)) if envelope.topic.per_frame else []
        for message in messages:
            yield Envelope.wrap(
                message, envelope.stamp, vehicle=source.mission.vehicle, camera=source.mission.camera.name
            )


def paced(envelopes: Iterable[Envelope], speed: Speed) -> Iterator[Envelope]:
    """Yield envelopes when they are due: captures lie apart as they did, divided by ``speed``; at "max", at once."""
    if speed == "max":
        yield from envelopes
        return
    if not speed > 0:
        raise ValueError(f"speed must be a positive factor or max, got {speed}")
    start: tuple[float, int] | None = None
    for envelope in envelopes:
        if envelope.topic is FRAME:
            if start is None:
                start = time.monotonic(), envelope.stamp.t_capture_ns
            due_s = start[0] + (envelope.stamp.t_capture_ns - start[1]) / NS_PER_S / speed
            time.sleep(max(due_s - time.monotonic(), 0.0))
        yield envelope


def differences(run_a: str | Path, run_b: str | Path, topics: Sequence[Topic] = REPEATABLE) -> list[str]:
    """Return, a line each, where two recorded runs differ in what a replay must repeat: nothing, when they agree.

    Messages are matched by topic and sequence and compared byte for byte.
    """
    a, b = (_by_frame(Recording(run), topics) for run in (run_a, run_b))
    lines = []
    for name, sequence in sorted(a.keys() | b.keys(), key=lambda key: (key[1], key[0])):
        pairs = zip_longest(a.get((name, sequence), ()), b.get((name, sequence), ()))
        for one, other in pairs:
            where = f"{name} of frame {sequence}"
            if one is None or other is None:
                lines.append(f"{where}: only in {run_b if one is None else run_a}")
            elif one.payload != other.payload:
                lines.append(f"{where}: {first_difference(_plain(one), _plain(other)) or 'other bytes, same fields'}")
    return lines


def _by_frame(recording: Recording, topics: Sequence[Topic]) -> dict[tuple[str, int], list[Envelope]]:
    grouped: dict[tuple[str, int], list[Envelope]] = {}
    for envelope, _ in recording.envelopes(topics):
        grouped.setdefault((envelope.topic.name, envelope.stamp.sequence), []).append(envelope)
    return grouped


def _plain(envelope: Envelope) -> Any:
    message = envelope.message()
    return message.model_dump() if isinstance(message, Message) else MessageToDict(message)


def first_difference(a: Any, b: Any, path: str = "") -> str | None:
    """Return the path to the first field in which two plain values differ and both values, None when they agree."""
    if isinstance(a, dict) and isinstance(b, dict):
        pairs = [(f"{path}.{key}".lstrip("."), a.get(key), b.get(key)) for key in a | b]
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        pairs = [(f"{path}[{k}]", x, y) for k, (x, y) in enumerate(zip(a, b, strict=True))]
    else:
        return None if a == b else f"{path} is {a!r} and {b!r}"
    return next((found for name, x, y in pairs if (found := first_difference(x, y, name))), None)
