"""The closed loop: a simulator flies, a camera looks, and what the pose filter makes of it flies the chaser.

``DockSource`` is a source of frames like any other, and takes the states back: with the steps of the pipeline behind
it, in one process or over the bus, the loop is closed.  A tick is a frame's period.  At each tick the camera looks at
the truth; then the bridge takes in the states that have come, the autopilot commands, and the simulator flies to the
next tick under that command.  In lockstep exactly the states of all frames before the newest have come, which is the
delay of one frame that a pipeline has, and lets it work while the next picture is made; so a run repeats itself to the
byte.  In real time, whatever has come by then counts.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from numpy.typing import NDArray

from astratag.transforms import exp_so3, inverse, rotation_from_wxyz, wxyz_from_rotation
from pipeline.bridge import NavigationBridge, OwnAttitude
from pipeline.convert import NS_PER_S, calibration_message, pose_message, vector_message
from pipeline.corridor import port_to_port
from pipeline.dock_scenario import DockScenario
from pipeline.guidance import PORTS_FACING, Autopilot, Command
from pipeline.hill import RelativeOrbit, TargetAttitude
from pipeline.plant import Departure, Flight, Plant
from pipeline.scenario import RelativeMotion
from pipeline.sim_camera import SimCamera
from pipeline.source import Source
from schemas import (
    ChaserMotion,
    Envelope,
    Guidance,
    Mode,
    Phase,
    Quaternion,
    RelativeState,
    Stamp,
    Truth,
    encode,
    topic_of,
)
from schemas.codec import AnyMessage
from schemas.topics import STATE

Array = NDArray[np.float64]

START_NS = 1_783_814_400 * NS_PER_S
"""2026-07-12T00:00:00Z, when every run in lockstep begins."""
POSITION_INFLATION, ATTITUDE_INFLATION = 10.0, 300.0
"""How many frames the errors of the pose filter last: a tilt that is read wrongly stays so until it is seen nearer."""
DISTURBANCE_M_S2 = 3e-4
"""What the bridge allows for beside the orbit and the thrust, held for a tick."""
TARGET_PRIOR_RAD = 0.05
TARGET_DRIFT_RAD_SQRT_S = 3e-4
GAP_TICKS = 3.5
"""Measurements farther apart are not without a gap."""
TRUTH_SIGMA = 1e-5
"""Standard deviation, m, rad, m/s and rad/s, that a flight on truth claims."""

BuildPlant = Callable[[DockScenario, Departure], Plant]


def require_basilisk() -> None:
    """Raise ValueError when Basilisk is not installed."""
    if find_spec("Basilisk") is None:
        raise ValueError("Basilisk is not installed: `make setup EXTRAS=dock` installs it, or `pip install bsk`")


def basilisk(scenario: DockScenario, departure: Departure) -> Plant:
    """Return Basilisk's plant.  Raises ValueError when Basilisk is not installed."""
    require_basilisk()
    from pipeline.basilisk_plant import BasiliskPlant

    return BasiliskPlant(scenario, departure)


@dataclass(frozen=True, eq=False)
class Draw:
    """What chance decides at the start of a run."""

    departure: Departure
    known_r_hill_m: Array
    known_v_hill_m_s: Array
    attitude_bias_rad: Array
    force_scale: Array

    @classmethod
    def of(cls, scenario: DockScenario) -> Draw:
        """Return the draw of a scenario's seed."""
        rng = np.random.default_rng((scenario.seed, 1))
        start, target, chaser, mission = scenario.start, scenario.target, scenario.chaser, scenario.mission
        R_hill_target = rotation_from_wxyz(target.R_hill_target_wxyz) @ exp_so3(
            rng.normal(0, target.attitude_sigma_rad, 3)
        )
        T_target_port, T_chaser_port = mission.T_target_port.matrix(), mission.T_chaser_port.matrix()
        facing = R_hill_target @ T_target_port[:3, :3] @ PORTS_FACING @ T_chaser_port[:3, :3].T
        R_hill_chaser = facing @ exp_so3(rng.normal(0, start.attitude_sigma_rad, 3))
        port = T_target_port[:3, 3] + T_target_port[:3, :3] @ np.array([0.0, 0.0, start.axial_m])
        r = R_hill_target @ port - R_hill_chaser @ T_chaser_port[:3, 3] + rng.normal(0, start.position_sigma_m, 3)
        v = rng.normal(0, start.velocity_sigma_m_s, 3)
        departure = Departure(r, v, R_hill_chaser, R_hill_target, rng.normal(0, target.rate_sigma_rad_s, 3))
        return cls(
            departure,
            r + rng.normal(0, start.known_position_sigma_m, 3),
            v + rng.normal(0, start.known_velocity_sigma_m_s, 3),
            rng.normal(0, chaser.attitude_bias_sigma_rad, 3),
            1 + rng.normal(0, chaser.force_scale_sigma, 3),
        )


def depart(scenario: DockScenario, build_plant: BuildPlant = basilisk) -> Plant:
    """Return the simulator at the start of a scenario's flight."""
    return build_plant(scenario, Draw.of(scenario).departure)


class Loop:
    """Plant, bridge and autopilot of one run, tick by tick."""

    def __init__(self, scenario: DockScenario, start_ns: int, plant: Plant):
        self._scenario, self._start_ns, self._plant = scenario, start_ns, plant
        draw = self._draw = Draw.of(scenario)
        self._rng = np.random.default_rng((scenario.seed, 2))
        self.tick_ns = round(NS_PER_S / scenario.camera.rate_hz)
        self._ticks = 0
        self.delta_v_m_s = 0.0
        start = scenario.start
        orbit = RelativeOrbit(
            np.concatenate([draw.known_r_hill_m, draw.known_v_hill_m_s]),
            np.diag([start.known_position_sigma_m**2] * 3 + [start.known_velocity_sigma_m_s**2] * 3),
            start_ns,
            rate_rad_s=scenario.orbit.rate_rad_s,
            inflation=POSITION_INFLATION,
            disturbance_m_s2=DISTURBANCE_M_S2,
            thrust_error_share=2 * scenario.chaser.force_scale_sigma,
        )
        nominal = rotation_from_wxyz(scenario.target.R_hill_target_wxyz)
        target = TargetAttitude(
            nominal, TARGET_PRIOR_RAD, start_ns, inflation=ATTITUDE_INFLATION, drift_rad_sqrt_s=TARGET_DRIFT_RAD_SQRT_S
        )
        middle = np.mean([marker.T_target_marker.translation_m for marker in scenario.mission.markers], axis=0)
        self.bridge = NavigationBridge(
            orbit, target, gap_s=GAP_TICKS / scenario.camera.rate_hz, p_target_marker_m=middle
        )
        self.autopilot = Autopilot(scenario.mission, scenario.chaser, scenario.guidance, scenario.safety, start_ns)
        self.flight = self._plant.flight()

    @property
    def t_ns(self) -> int:
        """Return the time of this tick, UTC."""
        return self._start_ns + self._ticks * self.tick_ns

    @property
    def t_s(self) -> float:
        """Return the time since the start."""
        return self._ticks * self.tick_ns / NS_PER_S

    def look(self) -> Truth:
        """Begin a tick: return the truth, and have the bridge hear of the chaser's own attitude."""
        self.flight = self._plant.flight()
        self.bridge.take_attitude(self._own_attitude(self.flight))
        motion = self.flight.relative
        return Truth(
            t_capture_ns=self.t_ns,
            T_chaser_target=pose_message(motion.T_a_b),
            v_chaser_target_m_s=vector_message(motion.v_a_b_m_s),
            omega_chaser_target_in_target_rad_s=vector_message(motion.omega_a_b_in_b_rad_s),
        )

    def act(self) -> tuple[Guidance, ChaserMotion]:
        """End a tick: command, and fly to the next; at contact, all is over.

        Returned with the guidance is what the chaser knows of its own motion until then: what its sensors have
        measured, and the force that it has asked for, not that which comes.
        """
        t_ns = self.t_ns
        navigation = self.bridge.navigation(t_ns)
        command = self.autopilot.command(navigation)
        own = navigation.own
        w, x, y, z = wxyz_from_rotation(own.R_hill_chaser).tolist()
        told = ChaserMotion(
            t_capture_ns=t_ns,
            rotation_hill_chaser_wxyz=Quaternion(w=w, x=x, y=y, z=z),
            omega_hill_chaser_in_chaser_rad_s=vector_message(own.omega_hill_chaser_in_chaser_rad_s),
            acceleration_chaser_m_s2=vector_message(command.force_chaser_n / self._scenario.chaser.mass_kg),
        )
        is_contact = axial_m(self._scenario, self.flight.relative) <= 0
        if not is_contact:
            self.bridge.take_thrust(t_ns, command.acceleration_hill_m_s2)
            self._fly(command)
        guidance = Guidance(
            t_capture_ns=t_ns,
            phase=Phase.CONTACT if is_contact else command.phase,
            reason="the ports touch" if is_contact else command.reason,
            navigation_age_s=navigation.age_s,
            position_sigma_m=navigation.position_sigma_m,
            p_targetport_chaserport_m=vector_message(command.place.p_m),
            v_targetport_chaserport_m_s=vector_message(command.place.v_m_s),
            force_chaser_n=vector_message(command.force_chaser_n),
            torque_chaser_n_m=vector_message(command.torque_chaser_n_m),
            delta_v_m_s=self.delta_v_m_s,
        )
        return guidance, told

    def is_over(self, guidance: Guidance) -> bool:
        """Tell whether there is nothing more to come."""
        if guidance.phase is Phase.SAFE:
            return self.autopilot.phase_s(self.t_ns) >= self._scenario.safety.settled_s
        return guidance.phase is Phase.CONTACT or self.t_s >= self._scenario.duration_max_s

    def _fly(self, command: Command) -> None:
        force = command.force_chaser_n * self._draw.force_scale
        self._ticks += 1
        self._plant.advance(self._ticks * self.tick_ns, force, command.torque_chaser_n_m)
        self.delta_v_m_s += float(np.linalg.norm(force)) / self._scenario.chaser.mass_kg * self.tick_ns / NS_PER_S

    def _own_attitude(self, flight: Flight) -> OwnAttitude:
        chaser = self._scenario.chaser
        off_rad = self._draw.attitude_bias_rad + self._rng.normal(0, chaser.attitude_noise_rad, 3)
        rate = flight.omega_hill_chaser_in_chaser_rad_s + self._rng.normal(0, chaser.rate_noise_rad_s, 3)
        return OwnAttitude(self.t_ns, flight.R_hill_chaser @ exp_so3(off_rad), rate)


class DockSource(Source):
    """The frames of a closed loop, its truth and its guidance; and a sink for the states that close it."""

    closed_loop = True

    def __init__(self, scenario: DockScenario, *, real_time: bool = False, build_plant: BuildPlant = basilisk):
        self.scenario, self.live = scenario, real_time
        self._build_plant = build_plant
        self._states: list[tuple[int, RelativeState]] = []
        self._newest_state, self._newest_frame = -1, -1
        camera, name = scenario.camera.camera(), scenario.mission.camera.name
        super().__init__(
            scenario.mission, calibration_message(camera, frame_id=name, t_capture_ns=START_NS), frame_count=None
        )

    @property
    def waits(self) -> bool:
        """Tell whether, in lockstep, the state of a frame before the newest has yet to come."""
        return not self.live and self._newest_state < self._newest_frame - 1

    def write(self, envelope: Envelope, t_receipt_ns: int) -> None:
        """Take a state back; anything else passes by."""
        if envelope.topic is STATE:
            state = envelope.message()
            assert isinstance(state, RelativeState)
            self._states.append((envelope.stamp.sequence, state))
            self._newest_state = max(self._newest_state, envelope.stamp.sequence)

    def envelopes(self) -> Iterator[Envelope]:
        """Yield the calibration, then truth, frame, guidance and own motion of every tick until the flight is over.

        In real time the flight begins now, and who draws the envelopes waits until each is due.
        """
        eye, plant = ScriptedEye(self.scenario), depart(self.scenario, self._build_plant)
        start_ns = time.time_ns() if self.live else START_NS
        loop = Loop(self.scenario, start_ns, plant)
        yield self._wrap(self.calibration, 0, start_ns)
        sequence = -1
        while True:
            t_ns, truth = loop.t_ns, loop.look()
            data = eye.look(loop.flight.relative, loop.t_s, t_ns)
            sequence += data is not None
            yield self._wrap(truth, max(sequence, 0), t_ns)
            if data is not None:
                image = CompressedImage(frame_id=self.mission.camera.name, data=data, format="jpeg")
                image.timestamp.FromNanoseconds(t_ns)
                self._newest_frame = sequence
                yield self._wrap(image, sequence, t_ns)
            for state in self._arrived():
                loop.bridge.take_state(state)
            guidance, told = loop.act()
            yield self._wrap(guidance, max(sequence, 0), t_ns)
            yield self._wrap(told, max(sequence, 0), t_ns)
            if loop.is_over(guidance):
                return

    def _arrived(self) -> list[RelativeState]:
        """Return the states that count by now, in order, and forget them."""
        due = [pair for pair in self._states if self.live or pair[0] < self._newest_frame]
        self._states = [pair for pair in self._states if pair not in due]
        return [state for _, state in due]

    def _wrap(self, message: AnyMessage, sequence: int, t_ns: int) -> Envelope:
        return self._envelope(topic_of(message), encode(message), Stamp(sequence, t_ns, 0))


class ScriptedEye:
    """The simulated camera with the faults of the scenario."""

    def __init__(self, scenario: DockScenario):
        self._scenario = scenario
        self._camera = SimCamera(
            scenario.camera.camera(), scenario.mission, light=scenario.light, sensor=scenario.sensor, seed=scenario.seed
        )
        self._rng = np.random.default_rng((scenario.seed, 3))
        self._T_cam_chaser = inverse(scenario.mission.camera.T_chaser_cam.matrix())
        self._blind_since_s: float | None = None

    def look(self, relative: RelativeMotion, t_s: float, t_ns: int) -> bytes | None:
        """Return the picture of a tick as JPEG, None when the camera drops it."""
        is_dropped = self._rng.random() < self._scenario.faults.drop_share
        is_blind = self._is_blind(relative, t_s)
        if is_dropped:
            return None
        return self._camera.jpeg(self._T_cam_chaser @ relative.T_a_b, t_ns, glare=1.0 if is_blind else 0.0)

    def _is_blind(self, relative: RelativeMotion, t_s: float) -> bool:
        blind = self._scenario.faults.blind
        if blind is None:
            return False
        if self._blind_since_s is None and axial_m(self._scenario, relative) < blind.below_m:
            self._blind_since_s = t_s
        if self._blind_since_s is None:
            return False
        return blind.duration_s is None or t_s - self._blind_since_s < blind.duration_s


def fly_on_truth(scenario: DockScenario, build_plant: BuildPlant = basilisk) -> list[tuple[Truth, Guidance]]:
    """Return the same flight with the truth for a state, a frame late like any, and no picture lost or blinded."""
    loop, ticks = Loop(scenario, START_NS, depart(scenario, build_plant)), []
    late: RelativeState | None = None
    while True:
        truth = loop.look()
        if late is not None:
            loop.bridge.take_state(late)
        late = RelativeState(
            t_capture_ns=truth.t_capture_ns,
            mode=Mode.TRACK,
            T_chaser_target=truth.T_chaser_target,
            v_chaser_target_m_s=truth.v_chaser_target_m_s,
            omega_chaser_target_in_target_rad_s=truth.omega_chaser_target_in_target_rad_s,
            covariance=(TRUTH_SIGMA**2 * np.eye(12)).ravel().tolist(),
            age_s=0.0,
        )
        guidance, _ = loop.act()
        ticks.append((truth, guidance))
        if loop.is_over(guidance):
            return ticks


def axial_m(scenario: DockScenario, relative: RelativeMotion) -> float:
    """Return how far apart the ports are along the target port's axis."""
    port = port_to_port(scenario.mission, relative.T_a_b, relative.v_a_b_m_s, relative.omega_a_b_in_b_rad_s)
    return port.axial_m
