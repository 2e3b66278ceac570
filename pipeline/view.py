"""The viewer: what the pipeline sees and estimates, in Rerun, as a file and live.

The scene is drawn in the target's docking port frame (z out of the target, y up), so the target stands still
and the chaser comes in.  One colour means one thing everywhere: blue is estimated, green is true, grey is a
bound, violet the corridor; warm colours are the marker's layers.
"""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log
from numpy.typing import NDArray
from scipy.stats import chi2

from astratag.artwork import artwork_image
from astratag.camera import Camera
from astratag.dictionary import load_dictionary
from astratag.geometry import QUIET_MARGIN
from astratag.surface import Flat, Surface
from astratag.transforms import difference, transform
from pipeline.convert import NS_PER_S, camera_from_calibration, points_array, pose_matrix, vector_array
from pipeline.mission import Mission
from pipeline.view_geometry import (
    Mesh,
    PortMotion,
    chaser_pose,
    corridor_mesh,
    corridor_strips,
    dashed,
    ellipsoid,
    port_motion,
    print_mesh,
    target_bodies,
)
from schemas import Detection, Detections, Envelope, Mode, RelativeState, Truth
from schemas.topics import CALIBRATION, DETECTIONS, EVENTS, FRAME, STATE, TRUTH

Array = NDArray[np.float64]
ViewMode = Literal["native", "web", "none"]
Warn = Callable[[str], None]

APPLICATION = "relnav"
LIVE_IMAGE_RATE_HZ = 15.0
"""More images a second than this fill a live viewer's memory and show nothing more."""
LIVE_MEMORY = "512MiB"
"""What a viewer that connects late is given of the past."""
START_TIMEOUT_S = 20.0
SETTLE_S = 1.0
VIEWER_COMMAND = (sys.executable, "-m", "rerun")
KEPT_FRAMES = 256
"""Frames for which a truth waits for its state, or the other way round."""
NIS_BAND = (0.025, 0.975)
SIGMAS = 3.0
OUT_OF_SIGHT_M = (0.0, 1e3, 1e3)
"""Where a chaser without a state waits: behind every eye that looks at the target."""
CHASER_M = (0.11, 0.11, 0.13)
"""The chaser as drawn: width, height and depth behind its docking port."""

ESTIMATE, TRUE, BOUND, CORRIDOR, GRID = 0x4CB8FFFF, 0x8CE05AFF, 0x8B93A3FF, 0x9B7BFFFF, 0xFFFFFF50
LAYER_COLORS = (0xFFD23FFF, 0xFF8C42FF, 0xFF4D6DFF)
LAYER_NAMES = ("outer", "middle", "inner")
AXIS_COLORS = (0xFF5050FF, 0x50E050FF, 0x5090FFFF)
MODE_COLORS = {
    Mode.INIT: 0x6B7280FF,
    Mode.AMBIGUOUS: 0xC77DFFFF,
    Mode.TRACK: ESTIMATE,
    Mode.COAST: 0xFFB020FF,
    Mode.LOST: 0xFF4040FF,
}
LOG_LEVELS = {
    Log.DEBUG: rr.TextLogLevel.DEBUG,
    Log.INFO: rr.TextLogLevel.INFO,
    Log.WARNING: rr.TextLogLevel.WARN,
    Log.ERROR: rr.TextLogLevel.ERROR,
    Log.FATAL: rr.TextLogLevel.CRITICAL,
}

CHASER = "scene/estimate/chaser"
CAMERA = f"{CHASER}/camera"
IMAGE = f"{CAMERA}/image"
OVERLAY = f"{CAMERA}/overlay"
PATHS = ("scene/estimate/path", "scene/truth/path")

PLOTS = (
    ("range_m", "Range, port to port [m]"),
    ("lateral_mm", "Lateral offset [mm]"),
    ("closing_mm_s", "Closing speed [mm/s]"),
    ("seen", "Seen in the picture"),
    ("position_error_mm", "Position error [mm]"),
    ("attitude_error_deg", "Attitude error [deg]"),
    ("nis", "NIS per degree of freedom"),
    ("latency_ms", "Latency, frame to state [ms]"),
)
WITH_LEGEND = ("range_m", "seen", "position_error_mm")

LEGEND = """\
A **chaser** flies down a corridor to a **target** and measures where it is from the printed markers.

- **blue** estimated, **green** true (when recorded)
- **grey** three-sigma and 95 % bounds
- **violet** approach corridor
- marker layers: **yellow** outer, **orange** middle, **red** inner; *dashed* predicted, *white grid* curved print
"""


class Viewer:
    """A sink that draws what passes.

    Writes ``rrd_path`` (None: no file), and shows it live: ``mode`` "native" starts Rerun's window, "web" serves
    a page at ``url``.  A window that cannot be opened costs one call of ``warn`` and nothing else: the run and
    the file go on.  Raises ValueError when the file cannot be written or a port of the web page is taken.
    """

    def __init__(
        self,
        mission: Mission,
        *,
        rrd_path: Path | None,
        mode: ViewMode = "none",
        web_port: int = 9090,
        grpc_port: int = 9876,
        host: str = "127.0.0.1",
        calibration: CameraCalibration | None = None,
        warn: Warn | None = None,
    ):
        self.url: str | None = None
        """Where the live view is, None when there is none."""
        self._mission = mission
        self._warn = warn or logging.getLogger(__name__).warning
        self._camera: Camera | None = None
        self._halves: dict[int, dict[str, Array]] = {}
        """By frame, T_chaser_target of an estimate that waits for its truth, or the other way round."""
        self._last: dict[str, Any] = {}
        """What was drawn last, where only a change is drawn."""
        self._T_chaser_port = mission.T_chaser_port.matrix()
        self._T_target_port = mission.T_target_port.matrix()
        self._file = _open_file(rrd_path) if rrd_path is not None else None
        self._live: _Live | None = None
        if mode == "web":
            self._live = _serve_web(host, web_port, grpc_port)
        elif mode == "native":
            self._live = _Window(grpc_port, self._warn)
        if self._live is not None:
            self.url = self._live.url
        self._handlers: dict[str, Callable[[Any, Envelope, int], None]] = {
            CALIBRATION.name: self._draw_calibration,
            FRAME.name: self._draw_frame,
            DETECTIONS.name: self._draw_detections,
            STATE.name: self._draw_state,
            TRUTH.name: self._draw_truth,
            EVENTS.name: self._draw_event,
        }
        self._draw_static()
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
        """Finish the file and send the rest to the window; a served page ends here."""
        if self._live is not None:
            self._live.close()
            self._live = None
        if self._file is not None:
            self._file.disconnect()
            self._file = None

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _streams(self) -> Iterable[rr.RecordingStream]:
        if self._file is not None:
            yield self._file
        if self._live is not None and self._live.stream is not None:
            yield self._live.stream

    def _log(self, path: str, *archetypes: rr.AsComponents, static: bool = False) -> None:
        for stream in self._streams():
            stream.log(path, *archetypes, static=static)

    # What never changes

    def _draw_static(self) -> None:
        blueprint = _blueprint(self._mission)
        for stream in self._streams():
            stream.send_blueprint(blueprint)
        self._log("legend", rr.TextDocument(LEGEND, media_type=rr.MediaType.MARKDOWN), static=True)
        self._log("scene", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        self._log("scene/target", _transform3d(chaser_pose(np.eye(4), self._T_target_port)), static=True)
        corridor = self._mission.corridor
        self._log("scene/corridor", _mesh3d(corridor_mesh(corridor), color=CORRIDOR & ~0xFF | 0x18), static=True)
        self._log(
            "scene/corridor/edges",
            rr.LineStrips3D(corridor_strips(corridor), colors=CORRIDOR & ~0xFF | 0x90, radii=rr.Radius.ui_points(0.6)),
            static=True,
        )
        markers = [(m.id, m.T_target_marker.matrix(), m.side_m, m.surface.surface()) for m in self._mission.markers]
        self._draw_target(markers)
        self._draw_vehicle("estimate", ESTIMATE, width=1.5)
        style = rr.Ellipsoids3D.from_fields(
            colors=[ESTIMATE], fill_mode=rr.components.FillMode.TransparentFillMajorWireframe, line_radii=[-1.0]
        )
        self._log("scene/estimate/ellipsoid", style, static=True)
        self._draw_overlay_styles()
        self._draw_series()

    def _draw_target(self, markers: list[tuple[int, Array, float, Surface]]) -> None:
        for k, (T_target_body, mesh) in enumerate(target_bodies([marker[1:] for marker in markers])):
            path = f"scene/target/body_{k}"
            self._log(path, _transform3d(T_target_body), _mesh3d(mesh, color=0x5A6475FF), static=True)
        dictionary = load_dictionary(self._mission.dictionary)
        for marker_id, T_target_marker, side_m, surface in markers:
            artwork = artwork_image(dictionary.signature(marker_id))
            pad = round(QUIET_MARGIN * len(artwork))
            texture = np.pad(artwork, pad, constant_values=255)[::2, ::2]
            drawn = _mesh3d(print_mesh(side_m, surface), texture=np.repeat(texture[..., None], 3, axis=2))
            path = f"scene/target/marker_{marker_id}"
            self._log(path, _transform3d(T_target_marker), drawn, static=True)

    def _draw_vehicle(self, whose: str, color: int, *, width: float) -> None:
        """Draw a chaser's hull in its own frame and style its path, in lines of ``width`` points of the screen."""
        half = np.array(CHASER_M) / 2
        radius = rr.Radius.ui_points(width)
        box = rr.Boxes3D(
            centers=[(0.0, 0.0, -half[2])],
            half_sizes=[half],
            colors=color,
            radii=radius,
            fill_mode=rr.components.FillMode.MajorWireframe,
        )
        hull = f"scene/{whose}/chaser/hull"
        self._log(hull, _transform3d(self._T_chaser_port), box, static=True)
        style = rr.LineStrips3D.from_fields(colors=[color], radii=radius)
        self._log(f"scene/{whose}/path", style, static=True)

    def _draw_overlay_styles(self) -> None:
        """Style what is drawn into the picture; radii are in points of the screen, whatever the zoom."""
        ui_points = rr.Radius.ui_points
        styles = {
            "quads": rr.LineStrips2D.from_fields(radii=ui_points(2.0)),
            "predicted": rr.LineStrips2D.from_fields(colors=[LAYER_COLORS[0]], radii=ui_points(0.75)),
            "grid": rr.LineStrips2D.from_fields(colors=[GRID], radii=ui_points(0.5)),
            "axes": rr.LineStrips2D.from_fields(radii=ui_points(1.5)),
            "labels": rr.Points2D.from_fields(colors=[0xFFFFFFFF], radii=[0.0], show_labels=True),
        }
        for name, style in styles.items():
            self._log(f"{OVERLAY}/{name}", style, static=True)

    def _draw_series(self) -> None:
        three_sigma = f"{SIGMAS:.0f} sigma"
        for name in ("range_m", "lateral_mm", "closing_mm_s"):
            _style(self._log, f"plots/{name}/bound", [f"+{three_sigma}", f"-{three_sigma}"], [BOUND] * 2, width=1.0)
            _style(self._log, f"plots/{name}/truth", ["truth"], [TRUE], width=1.2)
            _style(self._log, f"plots/{name}/estimate", ["estimate"], [ESTIMATE], width=2.5)
        for name in ("position_error_mm", "attitude_error_deg"):
            _style(self._log, f"plots/{name}/bound", [three_sigma], [BOUND], width=1.0)
            _style(self._log, f"plots/{name}/error", ["estimate - truth"], [ESTIMATE])
        _style(self._log, "plots/nis/bound", ["95 % low", "95 % high"], [BOUND] * 2, width=1.0)
        _style(self._log, "plots/nis/nis", ["NIS / dof"], [ESTIMATE])
        _style(self._log, "plots/latency_ms", ["frame to state"], [ESTIMATE])
        _style(self._log, "plots/seen", ["markers", "layers"], [ESTIMATE, LAYER_COLORS[0]])
        modes = [mode.name for mode in Mode]
        self._log(
            "status/filter_mode", rr.StateConfiguration(values=modes, colors=_rgba(MODE_COLORS.values())), static=True
        )
        largest = rr.StateConfiguration(values=[*LAYER_NAMES, "none"], colors=_rgba((*LAYER_COLORS, 0x3A3F4AFF)))
        self._log("status/largest_layer", largest, static=True)
        inside = rr.StateConfiguration(values=["inside", "outside"], colors=_rgba((CORRIDOR, 0xFF4040FF)))
        self._log("status/corridor", inside, static=True)

    # What passes

    def _set_camera(self, message: CameraCalibration) -> None:
        camera = self._camera = camera_from_calibration(message)
        pinhole = rr.Pinhole.from_fields(
            image_from_camera=camera.K,
            resolution=(camera.width, camera.height),
            color=ESTIMATE,
            line_width=-1.0,  # negative: in points of the screen
        )
        self._log(CAMERA, pinhole, _transform3d(self._mission.camera.T_chaser_cam.matrix()), static=True)

    def _draw_calibration(self, message: CameraCalibration, _envelope: Envelope, _t_ns: int) -> None:
        self._set_camera(message)

    def _draw_frame(self, message: CompressedImage, _envelope: Envelope, t_receipt_ns: int) -> None:
        if "chaser shown" not in self._last:
            self._hide_chaser()
        image = rr.EncodedImage(contents=message.data, media_type=f"image/{message.format or 'jpeg'}")
        if self._file is not None:
            self._file.log(IMAGE, image)
        if self._live is not None:
            self._live.log_image(IMAGE, image, t_receipt_ns)

    def _draw_detections(self, message: Detections, _envelope: Envelope, _t_ns: int) -> None:
        found = message.detections
        layers = [seen.layer for detection in found for seen in detection.layers]
        self._log("plots/seen", rr.Scalars([len(found), len(layers)]))
        self._draw_status("largest_layer", LAYER_NAMES[min(layers)] if layers else "none")
        if not found:
            if self._changed("overlay", False):
                self._log(OVERLAY, rr.Clear(recursive=True))
            return
        self._last["overlay"] = True
        quads = np.array([points_array(seen.corners_px)[[0, 1, 2, 3, 0]] for d in found for seen in d.layers])
        colors = _rgba(LAYER_COLORS[layer] for layer in layers)
        self._log(f"{OVERLAY}/quads", rr.LineStrips2D.from_fields(strips=quads, colors=colors))
        predicted = [dashed(points_array(d.corners_px)) for d in found if all(seen.layer != 0 for seen in d.layers)]
        self._draw_strips("predicted", predicted)
        self._draw_strips("grid", [lines for d in found if (lines := _grid_lines(d)) is not None])
        self._draw_labels(message)
        axes = [strips for d in found if (strips := self._axis_strips(d)) is not None]
        colors = _rgba(AXIS_COLORS * len(axes))
        self._log(f"{OVERLAY}/axes", rr.LineStrips2D.from_fields(strips=_joined(axes), colors=colors))

    def _draw_strips(self, name: str, strips: list[Array]) -> None:
        """Draw strips (each (n, points, 2), equal points) into the picture; no strips twice are drawn once."""
        if self._changed(f"{name} drawn", bool(strips)) or strips:
            self._log(f"{OVERLAY}/{name}", rr.LineStrips2D.from_fields(strips=_joined(strips)))

    def _draw_labels(self, message: Detections) -> None:
        """Write each marker's identity above it, inside the image."""
        at, labels = [], []
        for detection in message.detections:
            x, y = points_array(detection.corners_px).T
            at.append(
                (
                    np.clip(x.mean(), 0.2 * message.width_px, 0.8 * message.width_px),
                    np.clip(y.min() - 0.06 * message.height_px, 0.05 * message.height_px, 0.95 * message.height_px),
                )
            )
            layers = "+".join(LAYER_NAMES[seen.layer] for seen in detection.layers)
            labels.append(f"marker {detection.marker_id} · {layers} · {detection.method}")
        self._log(f"{OVERLAY}/labels", rr.Points2D.from_fields(positions=at, labels=labels))

    def _axis_strips(self, detection: Detection) -> Array | None:
        """Return the marker's x, y and z axes (3, 2, 2), half a side long, in the image."""
        if detection.T_cam_marker is None or self._camera is None:
            return None
        T_cam_marker = pose_matrix(detection.T_cam_marker)
        marker = self._mission.marker(detection.marker_id)
        length_m = 0.5 * (marker.side_m if marker else self._mission.default_side_m)
        ends_cam = transform(T_cam_marker, length_m * np.vstack([np.zeros(3), np.eye(3)]))
        if (ends_cam[:, 2] < 0.1 * length_m).any():
            return None
        origin, *ends = self._camera.project(ends_cam)
        return np.array([(origin, end) for end in ends])

    def _draw_state(self, state: RelativeState, envelope: Envelope, t_receipt_ns: int) -> None:
        self._draw_status("filter_mode", state.mode.name)
        if envelope.stamp.t_origin_ns > 0:
            self._log("plots/latency_ms", rr.Scalars(1e-6 * (t_receipt_ns - envelope.stamp.t_origin_ns)))
        if state.nis is not None and state.nis_dof > 0:
            self._last["nis"] = True
            self._log("plots/nis/nis", rr.Scalars(state.nis / state.nis_dof))
            self._log("plots/nis/bound", rr.Scalars(_nis_band(state.nis_dof)))
        elif self._changed("nis", False):
            self._log("plots/nis/nis", rr.Scalars(np.nan))  # a gap in the line
        if state.port is not None:
            self._draw_status("corridor", "inside" if state.port.in_corridor else "outside")
        if state.T_chaser_target is None:
            self._hide_chaser()
            return
        if not self._mission.markers and state.marker_ids and self._changed("target", state.marker_ids[0]):
            self._draw_target([(state.marker_ids[0], np.eye(4), self._mission.default_side_m, Flat())])
        T_chaser_target = pose_matrix(state.T_chaser_target)
        self._draw_estimate(state, T_chaser_target)
        self._draw_errors(envelope.stamp.sequence, estimate=T_chaser_target)

    def _draw_estimate(self, state: RelativeState, T_chaser_target: Array) -> None:
        motion = self._motion(state, T_chaser_target)
        self._last["chaser shown"] = True
        self._draw_chaser("estimate", T_chaser_target, motion)
        self._draw_frustum(motion.range_m)
        if state.covariance is None:
            return
        covariance = np.reshape(state.covariance, (12, 12))
        for name, scale, value, row in motion.plotted():
            bound = SIGMAS * np.sqrt(row @ covariance @ row)
            low = value - bound if name == "closing_mm_s" else max(value - bound, 0.0)
            self._log(f"plots/{name}/bound", rr.Scalars([scale * (value + bound), scale * low]))
        position, attitude = (SIGMAS * np.sqrt(np.trace(covariance[k : k + 3, k : k + 3])) for k in (0, 3))
        self._log("plots/position_error_mm/bound", rr.Scalars(1e3 * position))
        self._log("plots/attitude_error_deg/bound", rr.Scalars(np.rad2deg(attitude)))
        half_sizes, quaternion = ellipsoid(motion.jacobian @ covariance @ motion.jacobian.T, SIGMAS)
        shape = rr.Ellipsoids3D.from_fields(
            centers=[motion.p_port_m], half_sizes=[half_sizes], quaternions=[rr.Quaternion(xyzw=quaternion)]
        )
        self._log("scene/estimate/ellipsoid", shape)

    def _draw_chaser(self, whose: str, T_chaser_target: Array, motion: PortMotion) -> None:
        """Move a chaser, add the last stretch to its path, and plot its motion."""
        self._log(f"scene/{whose}/chaser", _transform3d(chaser_pose(T_chaser_target, self._T_target_port)))
        before = self._last.get(whose)
        self._last[whose] = motion.p_port_m
        if before is not None:
            self._log(f"scene/{whose}/path", rr.LineStrips3D.from_fields(strips=np.array([[before, motion.p_port_m]])))
        for name, scale, value, _ in motion.plotted():
            self._log(f"plots/{name}/{whose}", rr.Scalars(scale * value))

    def _hide_chaser(self) -> None:
        """Put the estimated chaser out of sight: there is no state, and nowhere to draw it."""
        if self._changed("chaser shown", False):
            self._last.pop("estimate", None)
            self._log(CHASER, rr.Transform3D(translation=OUT_OF_SIGHT_M))
            self._log("scene/estimate/ellipsoid", rr.Clear(recursive=False))

    def _draw_frustum(self, range_m: float) -> None:
        """Keep the picture in the frustum between the camera and what it looks at."""
        distance_m = float(np.clip(0.4 * range_m, 0.02, 0.3))
        if abs(distance_m / self._last.get("frustum", np.inf) - 1) > 0.05:
            self._last["frustum"] = distance_m
            self._log(CAMERA, rr.Pinhole.from_fields(image_plane_distance=distance_m))

    def _draw_truth(self, truth: Truth, envelope: Envelope, _t_ns: int) -> None:
        if "truth" not in self._last:
            self._draw_vehicle("truth", TRUE, width=0.8)
        T_chaser_target = pose_matrix(truth.T_chaser_target)
        self._draw_chaser("truth", T_chaser_target, self._motion(truth, T_chaser_target))
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
        self._log("plots/position_error_mm/error", rr.Scalars(1e3 * np.linalg.norm(error[:3])))
        self._log("plots/attitude_error_deg/error", rr.Scalars(np.rad2deg(np.linalg.norm(error[3:]))))

    def _draw_event(self, message: Log, _envelope: Envelope, _t_ns: int) -> None:
        level = LOG_LEVELS.get(message.level, rr.TextLogLevel.INFO)
        self._log("events", rr.TextLog(message.message, level=level))

    def _draw_status(self, lane: str, status: str) -> None:
        if self._changed(lane, status):
            self._log(f"status/{lane}", rr.StateChange(state=status))

    def _changed(self, what: str, value: Any) -> bool:
        """Tell whether ``value`` is not what it was, and remember it."""
        before, self._last[what] = self._last.get(what), value
        return before != value

    def _motion(self, of: RelativeState | Truth, T_chaser_target: Array) -> PortMotion:
        v, omega = of.v_chaser_target_m_s, of.omega_chaser_target_in_target_rad_s
        return port_motion(
            T_chaser_target,
            np.zeros(3) if v is None else vector_array(v),
            np.zeros(3) if omega is None else vector_array(omega),
            self._T_chaser_port,
            self._T_target_port,
        )


@lru_cache
def _nis_band(dof: int) -> Array:
    """Return the interval that holds NIS per degree of freedom 95 % of the time."""
    return chi2.ppf(NIS_BAND, dof) / dof


def _transform3d(T_a_b: Array) -> rr.Transform3D:
    return rr.Transform3D(translation=T_a_b[:3, 3], mat3x3=T_a_b[:3, :3])


def _mesh3d(mesh: Mesh, *, color: int | None = None, texture: NDArray[np.uint8] | None = None) -> rr.Mesh3D:
    return rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.triangles,
        vertex_normals=mesh.normals,
        vertex_texcoords=mesh.texture,
        albedo_factor=color,
        albedo_texture=texture,
    )


def _rgba(colors: Iterable[int]) -> NDArray[np.uint32]:
    """Return colours 0xRRGGBBAA as Rerun reads them without doubt."""
    return np.fromiter(colors, dtype=np.uint32)


def _style(log: Callable[..., None], path: str, names: list[str], colors: list[int], width: float = 2.0) -> None:
    log(path, rr.SeriesLines(names=names, colors=_rgba(colors), widths=[width] * len(names)), static=True)


def _joined(strips: list[Array]) -> NDArray[np.float32]:
    """Return strips (n, points, 2) as one array."""
    return np.concatenate(strips, dtype=np.float32) if strips else np.zeros((0, 2, 2), np.float32)


def _grid_lines(detection: Detection) -> Array | None:
    """Return the rows and columns of the grid on which a curved print was read, (lines, points, 2)."""
    warp = detection.warp_grid
    if warp is None or warp.rows != warp.columns:
        return None
    grid = points_array(warp.points_px).reshape(warp.rows, warp.columns, 2)
    return np.concatenate([grid, grid.transpose(1, 0, 2)])


def _blueprint(mission: Mission) -> rrb.Blueprint:
    """Return the layout: camera and scene above, status beside them, plots below."""
    start_m = mission.corridor.start_m
    wide = _scene_view("Approach", start_m * np.array([0.95, 0.6, 1.0]), start_m * np.array([0.0, 0.0, 0.45]))
    near = _scene_view("Close-up", start_m * np.array([0.26, 0.16, 0.3]), start_m * np.array([0.0, 0.0, 0.06]))
    events = rrb.TextLogView(origin="events", name="Events", columns=rrb.TextLogColumns(text_log_columns=["Body"]))
    status = rrb.Vertical(
        rrb.TextDocumentView(origin="legend", name="What you see"),
        rrb.StateTimelineView(origin="status", name="Status"),
        events,
        row_shares=[0.37, 0.35, 0.28],
    )
    above = rrb.Horizontal(
        rrb.Spatial2DView(origin=CAMERA, name="Camera", background=[0, 0, 0]),
        rrb.Tabs(wide, near),
        status,
        column_shares=[0.42, 0.33, 0.25],
    )
    plots = [
        rrb.TimeSeriesView(
            origin=f"plots/{name}", name=title, plot_legend=rrb.PlotLegend("RightTop", visible=name in WITH_LEGEND)
        )
        for name, title in PLOTS
    ]
    return rrb.Blueprint(
        rrb.Vertical(above, rrb.Grid(*plots, grid_columns=4), row_shares=[0.51, 0.49]),
        rrb.TimePanel(state="collapsed", timeline="capture_time"),
        collapse_panels=True,
    )


def _scene_view(name: str, eye_m: Array, target_m: Array) -> rrb.Spatial3DView:
    """Return a view of the scene from ``eye_m`` to ``target_m``, both (3,) in the port frame, paths drawn whole."""
    past = [
        rrb.VisibleTimeRange(
            timeline, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
        )
        for timeline in ("frame", "capture_time")
    ]
    return rrb.Spatial3DView(
        origin="scene",
        contents=["$origin/**", f"- {OVERLAY}/**"],
        name=name,
        background=[18, 20, 26],
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=eye_m, look_target=target_m, eye_up=(0.0, 1.0, 0.0)),
        overrides={path: rrb.archetypes.VisibleTimeRanges(past) for path in PATHS},
    )


class _Live:
    """A stream to a viewer that someone watches; ``stream`` is None once it is given up."""

    def __init__(self, stream: rr.RecordingStream, url: str):
        self.stream: rr.RecordingStream | None = stream
        self.url = url
        self._next_image_ns = 0

    def log_image(self, path: str, image: rr.EncodedImage, t_receipt_ns: int) -> None:
        """Log an image unless one was logged just now."""
        if self.stream is not None and t_receipt_ns >= self._next_image_ns:
            self._next_image_ns = t_receipt_ns + int(NS_PER_S / LIVE_IMAGE_RATE_HZ)
            self.stream.log(path, image)

    def close(self) -> None:
        """Send what is left and disconnect."""
        stream, self.stream = self.stream, None
        if stream is not None:
            stream.flush(timeout_sec=5.0)
            stream.disconnect()


class _Window(_Live):
    """Rerun's own window: started beside the run and fed as soon as it listens; what comes before waits in memory."""

    def __init__(self, grpc_port: int, warn: Warn):
        super().__init__(rr.RecordingStream(APPLICATION), f"rerun+http://127.0.0.1:{grpc_port}/proxy")
        self._port = grpc_port
        self._warn = warn
        self._starter = threading.Thread(target=self._start, name="rerun window", daemon=True)
        self._starter.start()

    def close(self) -> None:
        """Wait for a window that is still opening, send it what is left and leave it open."""
        self._starter.join(START_TIMEOUT_S)
        try:
            super().close()
        except RuntimeError:
            self._warn("Rerun's window was closed before the end of the run")

    def _start(self) -> None:
        stream = self.stream
        assert stream is not None
        failure = None if _listening(self._port) else self._open()
        if failure is None:
            stream.connect_grpc(self.url)
        else:
            self.stream = None
            self._warn(f"Rerun's window did not open ({failure}); the run goes on without it")

    def _open(self) -> str | None:
        """Start the viewer and wait until it listens.  Return why it does not, None when it does."""
        if not has_display():
            return "there is no display"
        options = ("--port", str(self._port), "--bind", "127.0.0.1", "--hide-welcome-screen", "--expect-data-soon")
        quiet = subprocess.DEVNULL
        try:
            process = subprocess.Popen(
                [*VIEWER_COMMAND, *options], stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True
            )
        except OSError as error:
            return f"it cannot be started: {error.strerror}"
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < deadline_s:
            listening = _listening(self._port)
            time.sleep(SETTLE_S if listening else 0.1)  # it listens before it opens its window, which may fail
            if process.poll() is not None:
                return f"the viewer ended with code {process.returncode}"
            if listening:
                return None
        process.terminate()
        return f"it did not listen within {START_TIMEOUT_S:.0f} s"


def has_display() -> bool:
    """Tell whether a window can be opened here."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _listening(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=0.2).close()
    except OSError:
        return False
    return True


def _open_file(path: Path) -> rr.RecordingStream:
    """Return a stream into a new file.  Raises ValueError when it cannot be written."""
    stream = rr.RecordingStream(APPLICATION)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream.save(path)
    except (OSError, RuntimeError) as error:
        raise ValueError(f"cannot write {path}: {' '.join(str(error).split())}") from error
    return stream


def _serve_web(host: str, web_port: int, grpc_port: int) -> _Live:
    """Serve the data on ``host`` and the viewer's page.  Raises ValueError when a port is taken."""
    for name, port in (("web_port", web_port), ("grpc_port", grpc_port)):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError as error:
                raise ValueError(
                    f"{name} {port} on {host} cannot be used ({error.strerror}): is another viewer running? "
                    f"Give another {name}"
                ) from error
    stream = rr.RecordingStream(APPLICATION)
    stream.set_sinks(rr.GrpcServerSink(host, grpc_port, server_memory_limit=LIVE_MEMORY))
    rr.serve_web_viewer(web_port=web_port, open_browser=False)
    source = quote(f"rerun+http://localhost:{grpc_port}/proxy", safe="")
    return _Live(stream, f"http://localhost:{web_port}/?url={source}")
