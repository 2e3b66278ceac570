"""What a replay does when a node dies, cannot start, or the user has had enough."""

import os
import signal
from pathlib import Path

import pytest

from nodes.processes import PROCESSES, consumers, process_named, producers
from nodes.supervisor import Hooks, RunError, Supervisor
from pipeline.recording import Recording, recover
from schemas import RelativeState, Stamp
from schemas.topics import HEALTH, STATE
from tests.small_recording import plan, write_small_recording


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_recording(tmp_path_factory.mktemp("recording") / "small.mcap", frames=40)


class Hand:
    """Does one thing to a run when its first state has come, and keeps the notes."""

    def __init__(self, supervisor_of: "list[Supervisor]", deed: str, node: str = ""):
        self.supervisor_of, self.deed, self.node = supervisor_of, deed, node
        self.notes: list[str] = []

    def on_state(self, stamp: Stamp, state: RelativeState) -> None:
        deed, self.deed = self.deed, ""
        (supervisor,) = self.supervisor_of
        if deed == "kill":
            pid = supervisor.pid(self.node)
            assert pid is not None
            os.kill(pid, signal.SIGKILL)
        elif deed == "stop":
            supervisor.stop()


def supervised(run_plan, deed: str, node: str = "") -> tuple[Supervisor, Hand]:
    box: list[Supervisor] = []
    hand = Hand(box, deed, node)
    box.append(Supervisor(run_plan, Hooks(hand.on_state, hand.notes.append)))
    return box[0], hand


def test_a_required_node_that_dies_ends_a_replay_and_what_was_recorded_is_readable(recording, tmp_path):
    supervisor, _ = supervised(plan(recording, tmp_path, lossless=True), "kill", "pose_filter")
    with pytest.raises(RunError, match="the pose_filter died: killed by SIGKILL"):
        supervisor.run()
    assert all(supervisor.pid(process.name) is None or gone(supervisor, process.name) for process in PROCESSES)
    assert Recording(tmp_path / "run.mcap").topics()


def gone(supervisor: Supervisor, name: str) -> bool:
    """Tell whether a node's process has ended."""
    pid = supervisor.pid(name)
    assert pid is not None
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.slow
def test_a_viewer_that_dies_does_not_end_a_replay(recording, tmp_path):
    supervisor, hand = supervised(plan(recording, tmp_path, lossless=True, viewer=True), "kill", "viewer")
    outcome = supervisor.run()
    assert outcome.completed
    assert outcome.died == {"viewer"}
    assert any("the viewer died (killed by SIGKILL); the run goes on without it" in note for note in hand.notes)
    assert [e.stamp.sequence for e, _ in Recording(tmp_path / "run.mcap").envelopes([STATE])] == list(range(40))


@pytest.mark.slow
def test_a_viewer_that_cannot_start_is_not_waited_for(recording, tmp_path):
    """Its file cannot be written: the replay says so and goes on."""
    run_plan = plan(recording, tmp_path, lossless=True, speed="max", viewer=True)
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where a folder should be")
    run_plan.arguments["viewer"] = ["--out", str(blocked)]
    supervisor, hand = supervised(run_plan, "")
    assert supervisor.run().completed
    assert any(note.startswith("warning: the viewer died (cannot write") for note in hand.notes)
    assert Recording(tmp_path / "run.mcap").frame_count == 40


def test_a_node_that_cannot_start_says_why_in_one_line(recording, tmp_path):
    run_plan = plan(recording, tmp_path, lossless=True)
    run_plan.arguments["source"] = ["--source", str(tmp_path / "gone.mcap")]
    with pytest.raises(RunError, match="source: no such recording"):
        Supervisor(run_plan).run()


@pytest.mark.slow
def test_a_replay_that_the_user_stops_leaves_a_whole_recording(recording, tmp_path):
    supervisor, _ = supervised(plan(recording, tmp_path, lossless=True), "stop")
    assert not supervisor.run().completed
    assert recover(tmp_path / "run.mcap").whole


def test_data_flows_one_way_through_the_table_of_processes():
    """Each process hears only those before it: so nobody waits for somebody who waits for him."""
    for place, process in enumerate(PROCESSES):
        assert {PROCESSES.index(p) for p in producers(process)} <= set(range(place))
        assert {PROCESSES.index(p) for p in consumers(process)} <= set(range(place + 1, len(PROCESSES)))


def test_everything_recorded_is_published_by_somebody():
    published = {topic for process in PROCESSES for topic in process.publishes}
    assert set(process_named("recorder").consumes) - {HEALTH} <= published


def test_an_unknown_node_is_named():
    with pytest.raises(ValueError, match="there is no node 'dectector'; the nodes are source, detector"):
        process_named("dectector")
