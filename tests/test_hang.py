"""Nodes that hang in a live run, stopped whole or only in their work: they are killed and started again."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from nodes import supervisor as supervisor_module
from nodes.supervisor import Hooks, Supervisor
from schemas import Mode, RelativeState, Stamp
from tests.small_recording import plan, write_small_recording

PATIENCE_S = 90.0
"""For a lease of ten seconds and two starts on a machine that does other things too."""
HANGS_ON_SIGUSR1 = (
    "import signal, sys, time; signal.signal(signal.SIGUSR1, lambda *_: time.sleep(1e6)); "
    "from nodes.cli import main; sys.exit(main())"
)
"""A node whose work stands still at the signal while Zenoh's threads go on."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_recording(tmp_path_factory.mktemp("recording") / "small.mcap", frames=80)


class Hanger:
    """Lets one node hang once the run tracks, and ends the run when its successor makes it track again."""

    def __init__(self, node: str, how: signal.Signals) -> None:
        self.node, self.how = node, how
        self.hung_pid: int | None = None
        self.notes: list[str] = []
        self.modes: list[Mode] = []
        self.supervisor: Supervisor | None = None

    def on_state(self, stamp: Stamp, state: RelativeState) -> None:
        assert self.supervisor is not None
        if self.hung_pid is None:
            if state.mode == Mode.TRACK:
                self.hung_pid = self.supervisor.pid(self.node)
                assert self.hung_pid is not None
                os.kill(self.hung_pid, self.how)
            return
        self.modes.append(state.mode)
        if state.mode == Mode.TRACK and any("is back after" in note for note in self.notes):
            self.supervisor.stop()


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGSTOP, signal.SIGUSR1], ids=["the whole process", "only its work"])
@pytest.mark.parametrize("node", ["detector"])
def test_a_node_that_hangs_is_killed_and_the_run_tracks_again(
    node: str, how: signal.Signals, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor_module, "NODES", (sys.executable, "-P", "-c", HANGS_ON_SIGUSR1))
    run_plan = replace(plan(recording, tmp_path, lossless=False), duration_s=PATIENCE_S)
    run_plan.arguments["source"].append("--loop")  # type: ignore[attr-defined]
    hanger = Hanger(node, how)
    hanger.supervisor = Supervisor(run_plan, Hooks(hanger.on_state, hanger.notes.append))
    begun_s = time.monotonic()
    outcome = hanger.supervisor.run()
    assert time.monotonic() - begun_s < PATIENCE_S, hanger.notes
    assert outcome.died == {node}
    assert hanger.modes[-1] == Mode.TRACK and set(hanger.modes) - {Mode.TRACK}
    died = [note for note in hanger.notes if "died" in note]
    assert died == [f"warning: the {node} died (it no longer answered and was killed); starting it again"]
    assert hanger.hung_pid is not None
    with pytest.raises(ProcessLookupError):
        os.kill(hanger.hung_pid, 0)
