"""The viewer itself: a sink that turns each message into what changes in the drawing."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import rerun as rr
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from astratag.dictionary import load_dictionary
from astratag.surface import Flat
from astratag.transforms import difference
from pipeline.convert import camera_from_calibration, pose_matrix, vector_array
from pipeline.mission import Mission
from pipeline.view import layout
from pipeline.view.geometry import ELLIPSOID_SCALE, SIGMAS, PortMotion, chaser_pose, ellipsoid, port_motion
from pipeline.view.overlay import Overlay
from pipeline.view.scene import draw_corridor, draw_target, draw_vehicle, transform3d
from pipeline.view.streams import LOCALHOST, Live, Warn, Window, open_file, serve_web
from schemas import Detections, Envelope, Guidance, Phase, RelativeState, Truth
from schemas.topics import CALIBRATION, DETECTIONS, EVENTS, FRAME, GUIDANCE, STATE, TRUTH

Array = NDArray[np.float64]
ViewMode = Literal["native", "web", "none"]

KEPT_FRAMES = 256
"""Frames for which a truth waits for its estimate, or the other way round."""
NIS_BAND = (0.025, 0.975)
OUT_OF_SIGHT_M = (0.0, 1e3, 1e3)
"""Where a chaser without a state waits: behind every eye that looks at the target."""
TRUTH_SIZE = 1.15
"""The true chaser is drawn so much larger than the estimated one, to be seen around it."""
FRUSTUM_SHARE, FRUSTUM_M = 0.4, (0.02, 0.3)
"""How far before the camera its picture hangs: a share of the range, within limits in metres."""

LOG_LEVELS = {
    Log.DEBUG: rr.TextLogLevel.DEBUG,
    Log.INFO: rr.TextLogLevel.INFO,
    Log.WARNING: rr.TextLogLevel.WARN,
    Log.ERROR: rr.TextLogLevel.ERROR,
    Log.FATAL: rr.TextLogLevel.CRITICAL,
}


class Viewer:
    """A sink that draws what passes.

    Writes ``rrd_path`` (None: no file), and shows it live: ``mode`` "native" starts Rerun's window, "web" serves
    the data on ``host`` and a page at ``url``.  A window that cannot be opened costs one call of ``warn`` (which
    may come from another thread) and nothing else: the run and the file go on.

    Raises ValueError when the file cannot be written or a port of the web page is taken.
    """

    def __init__(
        self,
        mission: Mission,
        *,
        rrd_path: Path | None,
        mode: ViewMode = "none",
        web_port: int = 9090,
        grpc_port: int = 9876,
        host: str = LOCALHOST,
        calibration: CameraCalibration | None = None,
        warn: Warn | None = None,
    ):
        self._mission = mission
        self._warn = warn or logging.getLogger(__name__).warning
        self._T_chaser_port = mission.T_chaser_port.matrix()
        self._T_target_port = mission.T_target_port.matrix()
        self._last: dict[str, Any] = {}
        """What was drawn last, where only a change is drawn."""
        self._path_ends: dict[str, Array] = {}
        self._halves: dict[int, dict[str, Array]] = {}
        """By frame, T_chaser_target of an estimate that waits for its truth, or the other way round."""
        self._file = open_file(rrd_path) if rrd_path is not None else None
        self._live: Live | None = None
        if mode == "web":
            self._live = serve_web(host, web_port, grpc_port)
        elif mode == "native":
            self._live = Window(grpc_port, self._warn)
        self.url = self._live.url if self._live is not None else None
        """Where the live view is, None when there is none."""
        self._handlers: dict[str, Callable[[Any, Envelope, int], None]] = {
            CALIBRATION.name: lambda message, _envelope, _t_ns: self._set_camera(message),
            FRAME.name: self._draw_frame,
            DETECTIONS.name: self._draw_detections,
            STATE.name: self._draw_state,
            TRUTH.name: self._draw_truth,
            GUIDANCE.name: self._draw_guidance,
            EVENTS.name: self._draw_event,
        }
        self._draw_static()
        self._overlay = Overlay(self._log, mission)
        if calibration is not None:
            self._set_camera(calibration)

    def write(self, envelope: Envelope, t_receipt_ns: int) -> None:
        """Draw one envelope.  Raises CodecError when its bytes are damaged."""
        handler = self._handlers.get(envelope.topic.name)
        if handler is None:
            return
        message = envelope.message()
        for stream in self._streams():
            stream.set_time("frame", sequence=envelope.stamp.sequence)
            stream.set_time("capture_time", timestamp=np.datetime64(envelope.stamp.t_capture_ns, "ns"))
        handler(message, envelope, t_receipt_ns)

    def close(self) -> None:
        """Finish the file and send the rest to the window, which stays; a served page ends here."""
        live, self._live = self._live, None
        if live is not None:
            try:
                live.close()
            except RuntimeError:
                self._warn("Rerun's window was closed before the end of the run")
        if self._file is not None:
            self._file.disconnect()
            self._file = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _streams(self) -> Iterable[rr.RecordingStream]:
        live = self._live.stream if self._live is not None else None
        return [stream for stream in (self._file, live) if stream is not None]

    def _log(self, path: str, *archetypes: rr.AsComponents, static: bool = False) -> None:
        for stream in self._streams():
            stream.log(path, *archetypes, static=static)

    def _plot(self, name: str, values: ArrayLike) -> None:
        """Add a point to each line of a plot's entity."""
        self._log(f"plots/{name}", rr.Scalars(values))

    def _draw_static(self) -> None:
        blueprint = layout.blueprint(self._mission.corridor)
        for stream in self._streams():
            stream.send_blueprint(blueprint)
        self._log("legend", rr.TextDocument(layout.LEGEND, media_type=rr.MediaType.MARKDOWN), static=True)
        for name, lines in layout.series_styles().items():
            self._log(f"plots/{name}", lines, static=True)
        for path, lane in layout.status_styles().items():
            self._log(path, lane, static=True)
        self._log(layout.SCENE, rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        self._log(f"{layout.SCENE}/target", transform3d(chaser_pose(np.eye(4), self._T_target_port)), static=True)
        draw_corridor(self._log, self._mission.corridor, self._T_target_port)
        markers = [(m.id, m.T_target_marker.matrix(), m.side_m, m.surface.surface()) for m in self._mission.markers]
        draw_target(self._log, markers, load_dictionary(self._mission.dictionary))
        draw_vehicle(self._log, layout.ESTIMATE, self._T_chaser_port, color=layout.ESTIMATE_COLOR, width=1.2)
        cloud = rr.Ellipsoids3D.from_fields(
            colors=[layout.ESTIMATE_COLOR],
            fill_mode=rr.components.FillMode.TransparentFillMajorWireframe,
            line_radii=rr.Radius.ui_points(0.75),
        )
        self._log(f"{layout.ESTIMATE}/ellipsoid", cloud, static=True)

    def _set_camera(self, message: CameraCalibration) -> None:
        camera = self._overlay.camera = camera_from_calibration(message)
        pinhole = rr.Pinhole.from_fields(
            image_from_camera=camera.K,
            resolution=(camera.width, camera.height),
            color=layout.ESTIMATE_COLOR,
            line_width=-1.0,  # negative: in points of the screen
        )
        self._log(layout.CAMERA, pinhole, transform3d(self._mission.camera.T_chaser_cam.matrix()), static=True)

    def _draw_frame(self, message: CompressedImage, _envelope: Envelope, t_receipt_ns: int) -> None:
        if "chaser shown" not in self._last:
            self._hide_chaser()
        image = rr.EncodedImage(contents=message.data, media_type=f"image/{message.format or 'jpeg'}")
        if self._file is not None:
            self._file.log(layout.IMAGE, image)
        live = self._live
        if live is not None and live.stream is not None and live.wants_image(t_receipt_ns):
            live.stream.log(layout.IMAGE, image)

    def _draw_detections(self, message: Detections, _envelope: Envelope, _t_ns: int) -> None:
        layers = [seen.layer for detection in message.detections for seen in detection.layers]
        self._plot("seen", [len(message.detections), len(layers)])
        self._draw_status(layout.LARGEST_LAYER, layout.LAYER_NAMES[min(layers)] if layers else "none")
        self._overlay.draw(message)

    def _draw_state(self, state: RelativeState, envelope: Envelope, t_receipt_ns: int) -> None:
        self._draw_status(layout.MODE, state.mode.name)
        if envelope.stamp.t_origin_ns > 0:
            self._plot("latency_ms", 1e-6 * (t_receipt_ns - envelope.stamp.t_origin_ns))
        measured = state.nis is not None and state.nis_dof > 0
        if measured:
            assert state.nis is not None
            self._plot("nis", [state.nis / state.nis_dof, *_nis_band(state.nis_dof)])
        if self._changed("measured", measured) and not measured:
            self._plot("nis", [np.nan] * 3)  # a gap in the lines
        if state.port is not None:
            self._draw_status(layout.IN_CORRIDOR, "inside" if state.port.in_corridor else "outside")
        if state.T_chaser_target is None:
            self._hide_chaser()
            return
        if not self._mission.markers and state.marker_ids and self._changed("first marker", state.marker_ids[0]):
            first = (state.marker_ids[0], np.eye(4), self._mission.default_side_m, Flat())
            draw_target(self._log, [first], load_dictionary(self._mission.dictionary))
        T_chaser_target = pose_matrix(state.T_chaser_target)
        self._draw_estimate(state, T_chaser_target)
        self._draw_errors(envelope.stamp.sequence, estimate=T_chaser_target)

    def _draw_estimate(self, state: RelativeState, T_chaser_target: Array) -> None:
        motion = self._motion(state, T_chaser_target)
        self._last["chaser shown"] = True
        self._draw_chaser(layout.ESTIMATE, T_chaser_target, motion)
        self._draw_frustum(motion.range_m)
        unknown = np.full((12, 12), np.nan)
        covariance = unknown if state.covariance is None else np.reshape(state.covariance, (12, 12))
        settled = SIGMAS * _sigma(motion.closing_by, covariance) < self._mission.filter.initial_speed_m_s
        shown = covariance if settled else unknown  # bounds like the filter's first guess would flatten the plots
        for name, scale, value, by in motion.plotted():
            bound = SIGMAS * _sigma(by, shown)
            low = value - bound if name == "closing_mm_s" else np.maximum(value - bound, 0.0)
            self._plot(f"{name}/estimate", scale * np.array([value, value + bound, low]))
        position_m, attitude_rad = (SIGMAS * np.sqrt(np.trace(shown[k : k + 3, k : k + 3])) for k in (0, 3))
        self._plot("position_error_mm/bound", 1e3 * position_m)
        self._plot("attitude_error_deg/bound", np.rad2deg(attitude_rad))
        if state.covariance is None:
            return
        half_axes_m, xyzw = ellipsoid(motion.jacobian @ covariance @ motion.jacobian.T, SIGMAS * ELLIPSOID_SCALE)
        cloud = rr.Ellipsoids3D.from_fields(
            centers=[motion.p_port_m], half_sizes=[half_axes_m], quaternions=[rr.Quaternion(xyzw=xyzw)]
        )
        self._log(f"{layout.ESTIMATE}/ellipsoid", cloud)

    def _draw_truth(self, truth: Truth, envelope: Envelope, _t_ns: int) -> None:
        if layout.TRUTH not in self._path_ends:
            draw_vehicle(
                self._log, layout.TRUTH, self._T_chaser_port, color=layout.TRUTH_COLOR, width=0.8, size=TRUTH_SIZE
            )
        T_chaser_target = pose_matrix(truth.T_chaser_target)
        motion = self._motion(truth, T_chaser_target)
        self._draw_chaser(layout.TRUTH, T_chaser_target, motion)
        for name, scale, value, _ in motion.plotted():
            self._plot(f"{name}/truth", scale * value)
        self._draw_errors(envelope.stamp.sequence, truth=T_chaser_target)

    def _draw_errors(self, sequence: int, **half: Array) -> None:
        """Plot the errors of a frame when both its estimate and its truth, in either order, have come."""
        both = self._halves.pop(sequence, {}) | half
        if len(both) < 2:
            self._halves[sequence] = both
            if len(self._halves) > KEPT_FRAMES:
                del self._halves[next(iter(self._halves))]
            return
        error = difference(both["truth"], both["estimate"])
        self._plot("position_error_mm/error", 1e3 * np.linalg.norm(error[:3]))
        self._plot("attitude_error_deg/error", np.rad2deg(np.linalg.norm(error[3:])))

    def _draw_chaser(self, path: str, T_chaser_target: Array, motion: PortMotion) -> None:
        """Move a chaser, and add the last stretch to its path."""
        self._log(f"{path}/chaser", transform3d(chaser_pose(T_chaser_target, self._T_target_port)))
        before = self._path_ends.get(path)
        self._path_ends[path] = motion.p_port_m
        if before is not None:
            stretch = np.array([[before, motion.p_port_m]], np.float32)
            self._log(f"{path}/path", rr.LineStrips3D.from_fields(strips=stretch))

    def _hide_chaser(self) -> None:
        """Put the estimated chaser out of sight: there is no state, and nowhere to draw it."""
        if self._changed("chaser shown", False):
            self._path_ends.pop(layout.ESTIMATE, None)
            self._log(layout.CHASER, rr.Transform3D(translation=OUT_OF_SIGHT_M))
            self._log(f"{layout.ESTIMATE}/ellipsoid", rr.Clear(recursive=False))

    def _draw_frustum(self, range_m: float) -> None:
        """Keep the picture in the frustum between the camera and what it looks at."""
        distance_m = float(np.clip(FRUSTUM_SHARE * range_m, *FRUSTUM_M))
        if abs(distance_m / self._last.get("frustum", np.inf) - 1) > 0.05:
            self._last["frustum"] = distance_m
            self._log(layout.CAMERA, rr.Pinhole.from_fields(image_plane_distance=distance_m))

    def _draw_event(self, message: Log, _envelope: Envelope, _t_ns: int) -> None:
        level = LOG_LEVELS.get(message.level, rr.TextLogLevel.INFO)
        self._log("events", rr.TextLog(message.message, level=level))

    def _draw_guidance(self, guidance: Guidance, _envelope: Envelope, _t_ns: int) -> None:
        if self._changed("phase", guidance.phase):
            is_alarm = guidance.phase in (Phase.HOLD, Phase.RETREAT, Phase.SAFE)
            level = rr.TextLogLevel.WARN if is_alarm else rr.TextLogLevel.INFO
            self._log("events", rr.TextLog(f"{guidance.phase.name}: {guidance.reason}", level=level))
            self._log(layout.GUIDANCE_PHASE, rr.StateChange(state=guidance.phase.name))

    def _draw_status(self, lane: str, status: str) -> None:
        if self._changed(lane, status):
            self._log(lane, rr.StateChange(state=status))

    def _changed(self, what: str, value: Any) -> bool:
        """Tell whether ``value`` is not what it was, and remember it."""
        changed = what not in self._last or self._last[what] != value
        self._last[what] = value
        return changed

    def _motion(self, of: RelativeState | Truth, T_chaser_target: Array) -> PortMotion:
        v, omega = of.v_chaser_target_m_s, of.omega_chaser_target_in_target_rad_s
        return port_motion(
            T_chaser_target,
            np.zeros(3) if v is None else vector_array(v),
            np.zeros(3) if omega is None else vector_array(omega),
            self._T_chaser_port,
            self._T_target_port,
        )


def _sigma(by: Array, covariance: Array) -> float:
    """Return the standard deviation of a quantity from its derivative (12,) by the state."""
    return float(np.sqrt(by @ covariance @ by))


@lru_cache
def _nis_band(dof: int) -> Array:
    """Return the interval that holds NIS per degree of freedom 95 % of the time."""
    return chi2.ppf(NIS_BAND, dof) / dof
