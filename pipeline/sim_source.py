"""The simulated camera as a live source: an approach, a light and markers from a file in, frames with truth out."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from pydantic import Field, model_validator

from astratag.transforms import inverse
from pipeline.convert import NS_PER_S, calibration_message
from pipeline.mission import CameraSection, MarkerSection, Mission, PoseSection, Section, read_sections
from pipeline.scenario import Approach, frame_stamps_ns, truth_message
from pipeline.sim_camera import LightSection, SensorSection, SimCamera, SimCameraSection
from pipeline.source import Source
from schemas import Envelope, Stamp, encode, topic_of
from schemas.codec import AnyMessage

SIM_MISSION = Mission(
    camera=CameraSection(T_chaser_cam=PoseSection(translation_m=(0.25, 0.0, 0.0), rotation_wxyz=(0.5, 0.5, 0.5, 0.5))),
    markers=(MarkerSection(id=7),),
    T_chaser_port=PoseSection(translation_m=(0.25, 0.0, 0.0), rotation_wxyz=(0.5, 0.5, 0.5, 0.5)),
)


class SimScenario(Section):
    """What the simulated camera sees; ``approach`` is the motion of the first marker past the camera."""

    mission: Mission = SIM_MISSION
    approach: Approach = Approach()
    camera: SimCameraSection = SimCameraSection(width_px=1280, height_px=720, focal_px=1000.0, rate_hz=20.0)
    light: LightSection = LightSection()
    sensor: SensorSection = SensorSection()
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _has_markers(self) -> SimScenario:
        if not self.mission.markers:
            raise ValueError("the mission must map at least one marker: the simulated camera draws those")
        return self

    @classmethod
    def load(cls, path: str | Path) -> SimScenario:
        """Read a scenario file.  Raises ValueError when it cannot be read or is not valid."""
        return read_sections(cls, path, what="scenario")

    def to_json(self) -> str:
        """Return what the scenario says as JSON, which ``load`` reads back unchanged."""
        return json.dumps(self.model_dump(mode="json"), indent=2) + "\n"


class SimSource(Source):
    """A camera that exists in numbers only: live, it takes pictures as time passes, and misses those it is late for."""

    live = True

    def __init__(self, scenario: SimScenario, *, fps: float | None = None, paced: bool = True):
        self._scenario, self._paced = scenario, paced
        self._rate_hz = fps or scenario.camera.rate_hz
        self._start_ns = time.time_ns()
        name = scenario.mission.camera.name
        calibration = calibration_message(scenario.camera.camera(), frame_id=name, t_capture_ns=self._start_ns)
        super().__init__(scenario.mission, calibration, None)

    def envelopes(self) -> Iterator[Envelope]:
        """Yield the calibration, then the truth and the frame of each instant; a picture that is late is skipped."""
        scenario = self._scenario
        camera = SimCamera(
            scenario.camera.camera(), scenario.mission, light=scenario.light, sensor=scenario.sensor, seed=scenario.seed
        )
        start_ns = time.time_ns()
        yield self._wrap(self.calibration, Stamp(0, start_ns, 0))
        count = round(scenario.approach.duration_s * self._rate_hz) + 1
        period_ns = NS_PER_S / self._rate_hz
        for sequence, t_ns in enumerate(frame_stamps_ns(start_ns, self._rate_hz, count)):
            wait_ns = t_ns - time.time_ns() if self._paced else 0
            if wait_ns < -period_ns:
                self.skipped += 1
                continue
            time.sleep(max(wait_ns, 0) / NS_PER_S)
            yield from self._frame(camera, sequence, t_ns - start_ns, t_ns)

    def _frame(self, camera: SimCamera, sequence: int, since_start_ns: int, t_ns: int) -> Iterator[Envelope]:
        """Yield the truth and the frame of an instant: a scenario's pictures are the same whenever it is run."""
        mission, t_s = self.mission, since_start_ns / NS_PER_S
        motion, T_target_marker = self._scenario.approach.at(t_s), mission.markers[0].T_target_marker.matrix()
        T_chaser_cam = mission.camera.T_chaser_cam.matrix()
        truth = truth_message(motion, T_chaser_cam=T_chaser_cam, T_target_marker=T_target_marker, t_capture_ns=t_ns)
        yield self._wrap(truth, Stamp(sequence, t_ns, 0))
        data = camera.jpeg(motion.T_a_b @ inverse(T_target_marker), since_start_ns)
        image = CompressedImage(frame_id=mission.camera.name, data=data, format="jpeg")
        image.timestamp.FromNanoseconds(t_ns)
        yield self._wrap(image, Stamp(sequence, t_ns, 0))

    def _wrap(self, message: AnyMessage, stamp: Stamp) -> Envelope:
        return self._envelope(topic_of(message), encode(message), stamp)
