"""The supervisor: starts the nodes of a run, watches them, starts them again, and stops them.

Replay: the run is over when every node has ended.  A required node that dies ends it with an error.
Live: the run is over when the source has ended, the time is up or the user stops it.  A node that dies is
started again at once while the others go on; so is one that hangs, once it has been silent for ten seconds.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from nodes import ONE_THREAD
from nodes.bus import Bus, Credit, Link, Presence, Received
from nodes.processes import Process
from schemas import CodecError, NodeHealth, RelativeState, Stamp
from schemas.topics import HEALTH, STATE

POLL_S = 0.02
STOP_PATIENCE_S = 3.0
FINISH_PATIENCE_S = 15.0
"""For recorder and viewer to finish their files."""
HANG_PATIENCE_S = 1.0
"""For a process that is there and has left the bus: it is ending, or it hangs."""
SILENCE_PATIENCE_S = 10.0
"""For a live node to say how it is, which it does every second: Zenoh's own threads go on when its work hangs."""
LONGEST_TURN_S = 0.5
"""What of a turn counts as listening: when this process was stopped itself, nobody was silent."""
MOST_RESTARTS = 5
RESTART_MEMORY_S = 30.0
ERROR_PREFIX = "relnav: error: "
NODES = (sys.executable, "-P", "-m", "nodes")
"""The command line of the very code that runs here, whatever lies in the user's folder."""
ROOT = Path(__file__).resolve().parent.parent


class RunError(ValueError):
    """A run that did not do its job; the message is one line for the user."""


@dataclass(frozen=True)
class Plan:
    """What is to run."""

    processes: tuple[Process, ...]
    arguments: Mapping[str, Sequence[str]]
    """What each node's command line gets beyond what all get."""
    node_link: Link
    own_link: Link
    """The supervisor's: the hub, or a client of the router like the nodes."""
    vehicle: str
    lossless: bool
    mission_path: str
    duration_s: float | None = None


@dataclass(frozen=True)
class Hooks:
    """How the run is shown while it lasts."""

    on_state: Callable[[Stamp, RelativeState], None] = lambda stamp, state: None
    on_note: Callable[[str], None] = lambda note: None


@dataclass(frozen=True)
class Outcome:
    """How a run went."""

    completed: bool
    """False when the user stopped it."""
    died: frozenset[str]
    """Names of the nodes that died at least once."""


@dataclass
class Child:
    """One running node."""

    process: Process
    popen: subprocess.Popen[str]
    alive: bool = False
    """It has announced itself on the bus."""
    died_s: float | None = None
    """When the one before it died, until it has announced itself."""
    lapsed_s: float | None = None
    """When it left the bus."""
    silent_s: float = 0.0
    """How long it has not been heard since it announced itself."""
    hung: bool = False
    ended: bool = False
    lines: deque[str] = field(default_factory=lambda: deque(maxlen=50))
    reader: threading.Thread | None = None

    def close_pipes(self) -> None:
        """Read its last lines and let go of it; to be called when it has ended."""
        if self.reader is not None:
            self.reader.join(1.0)
        for pipe in (self.popen.stdin, self.popen.stderr):
            if pipe is not None:
                pipe.close()

    def epitaph(self) -> str:
        """Return in a few words why it is no more."""
        if self.hung:
            return "it no longer answered and was killed"
        code = self.popen.returncode
        if code < 0:
            return f"killed by {signal.Signals(-code).name}"
        errors = [line.removeprefix(ERROR_PREFIX) for line in self.lines if line.startswith(ERROR_PREFIX)]
        return (errors or [line for line in self.lines if line.strip()] or [f"exit code {code}"])[-1]


class Supervisor:
    """One run from its start to its end."""

    def __init__(self, plan: Plan, hooks: Hooks | None = None) -> None:
        self._plan, self._hooks = plan, hooks or Hooks()
        self._children: dict[str, Child] = {}
        self._restarts: dict[str, list[float]] = {process.name: [] for process in plan.processes}
        self._interrupted = threading.Event()
        self._last_frame: Stamp | None = None
        self._live_since_s: float | None = None
        self._died: set[str] = set()
        self._excuse_due_s = 0.0
        self._turned_s = time.monotonic()
        self._notes: dict[str, str] = {}

    def run(self) -> Outcome:
        """Run to the end, or until the user stops it.  Raises RunError and BusError."""
        plan = self._plan
        previous = {number: signal.signal(number, lambda *_: self.stop()) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            with Bus(plan.own_link, vehicle=plan.vehicle, node="supervisor", lossless=plan.lossless) as bus:
                bus.subscribe([STATE, HEALTH])
                bus.watch()
                try:
                    for process in reversed(plan.processes):  # whoever is waited for first
                        self._start(process)
                    while not self._interrupted.is_set() and not self._finished():
                        self._turn(bus)
                        self._excuse_missed(bus)
                finally:
                    self._stop()
                self._empty(bus)
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)
        return Outcome(completed=not self._interrupted.is_set(), died=frozenset(self._died))

    def stop(self) -> None:
        """End the run as Ctrl-C does; from a hook or another thread."""
        self._interrupted.set()

    def pid(self, name: str) -> int | None:
        """Return a node's process id, None when it is not running."""
        child = self._children.get(name)
        return None if child is None else child.popen.pid

    def _start(self, process: Process, *, died_s: float | None = None) -> None:
        plan = self._plan
        command = [*NODES, "node", process.name, "--supervised", "--mission", plan.mission_path]
        command += ["--connect" if plan.node_link.role == "client" else "--hub", plan.node_link.endpoint]
        if plan.lossless:
            command += ["--lossless", "--companions", ",".join(p.name for p in plan.processes if p.name != "source")]
        elif process.name == "source":
            command += ["--companions", ",".join(p.name for p in plan.processes if p.required and p.name != "source")]
            if self._last_frame is not None:
                command += ["--resume", f"{self._last_frame.sequence}:{self._last_frame.t_capture_ns}"]
        popen = subprocess.Popen(
            [*command, *plan.arguments.get(process.name, ())],
            stdin=subprocess.PIPE,  # its end tells the node that we are gone
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            env=_environment(),
            start_new_session=True,  # a Ctrl-C is for us: we stop the nodes in order
        )
        child = Child(process, popen, died_s=died_s)
        self._children[process.name] = child
        child.reader = threading.Thread(target=self._read_lines, args=(child,), daemon=True)
        child.reader.start()

    def _read_lines(self, child: Child) -> None:
        assert child.popen.stderr is not None
        for line in child.popen.stderr:
            child.lines.append(line.rstrip())
            if line.startswith("relnav: warning: "):
                self._hooks.on_note(line.rstrip().removeprefix("relnav: "))

    def _turn(self, bus: Bus) -> None:
        event = bus.mailbox.get(POLL_S)
        self._listen()
        match event:
            case Received():
                self._show(event)
            case Presence(node=name, alive=True) if name in self._children:
                self._welcome(self._children[name])
            case Presence(node=name, alive=False) if name in self._children and self._children[name].alive:
                self._children[name].lapsed_s = time.monotonic()  # not of one just started: its predecessor left
            case Credit(node=name, ended=True) if name in self._children:
                self._children[name].ended = True
        for child in list(self._children.values()):
            lapsed = child.lapsed_s is not None and time.monotonic() - child.lapsed_s > HANG_PATIENCE_S
            if lapsed or child.silent_s > SILENCE_PATIENCE_S:
                child.hung = True
                child.popen.kill()
                child.popen.wait()
            if child.popen.poll() is not None:
                self._mourn(child)

    def _listen(self) -> None:
        """Count the time in which live nodes could have been heard."""
        now_s = time.monotonic()
        listened_s, self._turned_s = min(now_s - self._turned_s, LONGEST_TURN_S), now_s
        if not self._plan.lossless:
            for child in self._children.values():
                child.silent_s += listened_s if child.alive else 0.0

    def _show(self, received: Received) -> None:
        stamp = received.envelope.stamp
        try:
            message = received.envelope.message()
        except CodecError:
            return
        if isinstance(message, RelativeState):
            if self._last_frame is None or stamp.sequence > self._last_frame.sequence:
                self._last_frame = stamp
            self._hooks.on_state(stamp, message)
        if not isinstance(message, NodeHealth):
            return
        if message.node in self._children:
            self._children[message.node].silent_s = 0.0
        if message.note and message.note != self._notes.get(message.node):
            self._notes[message.node] = message.note
            self._hooks.on_note(f"warning: {message.note}")

    def _welcome(self, child: Child) -> None:
        child.alive, child.lapsed_s, child.silent_s = True, None, 0.0
        if child.died_s is not None:
            self._hooks.on_note(f"{child.process.name} is back after {time.monotonic() - child.died_s:.1f} s")
            child.died_s = None
        if self._live_since_s is None and child.process.name == "source":
            self._live_since_s = time.monotonic()

    def _mourn(self, child: Child) -> None:
        name, now_s = child.process.name, time.monotonic()
        del self._children[name]
        self._died.add(name)
        child.close_pipes()
        why = child.epitaph()
        if self._plan.lossless:
            if child.process.required:
                raise RunError(f"{name}: {why}" if child.popen.returncode > 0 else f"the {name} died: {why}")
            self._hooks.on_note(f"warning: the {name} died ({why}); the run goes on without it")
            return
        self._restarts[name] = [t for t in self._restarts[name] if now_s - t < RESTART_MEMORY_S] + [now_s]
        hopeless = len(self._restarts[name]) > MOST_RESTARTS or (not child.alive and child.popen.returncode > 0)
        if hopeless and child.process.required:
            raise RunError(f"{name}: {why}")
        if hopeless:
            self._hooks.on_note(f"warning: the {name} does not stay up ({why}); the run goes on without it")
            return
        self._hooks.on_note(f"warning: the {name} died ({why}); starting it again")
        self._start(child.process, died_s=now_s if child.died_s is None else child.died_s)

    def _excuse_missed(self, bus: Bus) -> None:
        """Say until the source starts, to nodes that may still be coming up, for whom not to wait."""
        if not self._plan.lossless or self._live_since_s is not None:
            return
        if self._died and time.monotonic() >= self._excuse_due_s:
            self._excuse_due_s = time.monotonic() + 0.2
            for name in self._died:
                bus.send(Credit(name, ended=True))

    def _finished(self) -> bool:
        if self._plan.lossless:
            return all(child.ended for child in self._children.values())
        source = self._children.get("source")
        duration_s, since_s = self._plan.duration_s, self._live_since_s
        time_up = duration_s is not None and since_s is not None and time.monotonic() - since_s >= duration_s
        return time_up or (source is not None and source.ended)

    def _stop(self) -> None:
        """Stop who speaks before who listens, in the order of the data, so that nothing said is lost."""
        children = [self._children[p.name] for p in self._plan.processes if p.name in self._children]
        speakers = [[child] for child in children if child.process.publishes]
        listeners = [child for child in children if not child.process.publishes]
        for group in [*speakers, listeners]:
            for child in group:
                child.popen.send_signal(signal.SIGTERM)
            deadline_s = time.monotonic() + (FINISH_PATIENCE_S if group is listeners else STOP_PATIENCE_S)
            for child in group:
                try:
                    child.popen.wait(max(deadline_s - time.monotonic(), 0.01))
                except subprocess.TimeoutExpired:
                    child.popen.kill()
                    child.popen.wait()
                    self._died.add(child.process.name)
                    self._hooks.on_note(f"warning: the {child.process.name} did not stop when told and was killed")
                child.close_pipes()

    def _empty(self, bus: Bus) -> None:
        while (event := bus.mailbox.get(0.0)) is not None:
            if isinstance(event, Received):
                self._show(event)


def _environment() -> dict[str, str]:
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    return os.environ | ONE_THREAD | {"PYTHONPATH": path}
