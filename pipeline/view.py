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
CHASER_M = (0.16, 0.12, 0.14)
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

LEGEND = """\
A **chaser** flies down a corridor to a **target** and measures where it is from the printed markers.

**Blue** estimated · **green** true, when recorded · **grey** three-sigma bound · **violet** approach corridor

Marker layers: **yellow** outer · **orange** middle · **red** inner; *dashed* when predicted, not seen.

The blue ellipsoid holds the chaser with three sigma. Errors should stay below their grey bound, and NIS \
inside its band 95 % of the time.
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
        self._truths: dict[int, Truth] = {}
        self._states: dict[int, RelativeState] = {}
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
            stream.set_time("capture_time", timestamp=1e-9 * envelope.stamp.t_capture_ns)
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
        self._draw_vehicle(f"{CHASER}/body", ESTIMATE, solid=True)
        self._draw_vehicle("scene/truth/chaser/body", TRUE, solid=False)
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

    def _draw_vehicle(self, path: str, color: int, *, solid: bool) -> None:
        width, height, depth = CHASER_M
        self._log(path, _transform3d(self._T_chaser_port), static=True)
        shape = rr.Boxes3D(
            centers=[(0.0, 0.0, -depth / 2)],
            half_sizes=[(width / 2, height / 2, depth / 2)],
            colors=color & ~0xFF | (0xB0 if solid else 0xFF),
            fill_mode=rr.components.FillMode.Solid if solid else rr.components.FillMode.MajorWireframe,
            radii=rr.Radius.ui_points(1.2),
        )
        self._log(f"{path}/hull", shape, static=True)

    def _draw_series(self) -> None:
        three_sigma = f"{SIGMAS:.0f} sigma"
        for name in ("range_m", "lateral_mm", "closing_mm_s"):
            _style(self._log, f"plots/{name}/bound", [f"+{three_sigma}", f"-{three_sigma}"], [BOUND] * 2, width=1.0)
            _style(self._log, f"plots/{name}/truth", ["truth"], [TRUE])
            _style(self._log, f"plots/{name}/estimate", ["estimate"], [ESTIMATE])
        for name in ("position_error_mm", "attitude_error_deg"):
            _style(self._log, f"plots/{name}/bound", [three_sigma], [BOUND], width=1.0)
            _style(self._log, f"plots/{name}/error", ["estimate - truth"], [ESTIMATE])
        _style(self._log, "plots/nis/bound", ["95 % low", "95 % high"], [BOUND] * 2, width=1.0)
        _style(self._log, "plots/nis/nis", ["NIS / dof"], [ESTIMATE])
        _style(self._log, "plots/latency_ms", ["frame to state"], [ESTIMATE])
        _style(self._log, "plots/seen", ["markers", "layers"], [ESTIMATE, LAYER_COLORS[0]])
        modes = [mode.name for mode in Mode]
        self._log("status/mode", rr.StateConfiguration(values=modes, colors=_rgba(MODE_COLORS.values())), static=True)
        smallest = rr.StateConfiguration(values=[*LAYER_NAMES, "none"], colors=_rgba((*LAYER_COLORS, 0x3A3F4AFF)))
        self._log("status/layer", smallest, static=True)
        inside = rr.StateConfiguration(values=["inside", "outside"], colors=_rgba((CORRIDOR, 0xFF4040FF)))
        self._log("status/corridor", inside, static=True)

    # What passes

    def _set_camera(self, message: CameraCalibration) -> None:
        self._camera = camera_from_calibration(message)
        self._log(CAMERA, _transform3d(self._mission.camera.T_chaser_cam.matrix()), static=True)

    def _draw_calibration(self, message: CameraCalibration, _envelope: Envelope, _t_ns: int) -> None:
        self._set_camera(message)

    def _draw_frame(self, message: CompressedImage, _envelope: Envelope, t_receipt_ns: int) -> None:
        image = rr.EncodedImage(contents=message.data, media_type=f"image/{message.format or 'jpeg'}")
        if self._file is not None:
            self._file.log(IMAGE, image)
        if self._live is not None:
            self._live.log_image(IMAGE, image, t_receipt_ns)

    def _draw_detections(self, message: Detections, _envelope: Envelope, _t_ns: int) -> None:
        found = message.detections
        layers = [seen.layer for detection in found for seen in detection.layers]
        self._log("plots/seen", rr.Scalars([len(found), len(layers)]))
        self._draw_status("layer", LAYER_NAMES[max(layers)] if layers else "none")
        if not found:
            if self._changed("overlay", False):
                self._log(OVERLAY, rr.Clear(recursive=True))
            return
        self._last["overlay"] = True
        strips, colors, radii = _outlines(found)
        self._log(f"{OVERLAY}/quads", rr.LineStrips2D(strips, colors=_rgba(colors), radii=radii))
        self._draw_labels(message)
        grids = [strip for detection in found for strip in _grid_strips(detection)]
        self._log(f"{OVERLAY}/grid", rr.LineStrips2D(grids, colors=GRID, radii=rr.Radius.ui_points(0.5)))
        axes = [strip for detection in found for strip in self._axis_strips(detection)]
        colors = [AXIS_COLORS[k % 3] for k in range(len(axes))]
        self._log(f"{OVERLAY}/axes", rr.LineStrips2D(axes, colors=_rgba(colors), radii=rr.Radius.ui_points(1.5)))

    def _draw_labels(self, message: Detections) -> None:
        """Write each marker's identity above it, inside the image."""
        at, labels = [], []
        for detection in message.detections:
            x, y = points_array(detection.corners_px).T
            at.append(
                (
                    np.clip(x.mean(), 0.2 * message.width_px, 0.8 * message.width_px),
                    np.clip(y.min() - 0.04 * message.height_px, 0.05 * message.height_px, 0.95 * message.height_px),
                )
            )
            layers = "+".join(LAYER_NAMES[seen.layer] for seen in detection.layers)
            labels.append(f"marker {detection.marker_id} · {layers} · {detection.method}")
        self._log(f"{OVERLAY}/labels", rr.Points2D(at, labels=labels, radii=0.0, colors=0xFFFFFFFF, show_labels=True))

    def _axis_strips(self, detection: Detection) -> list[Array]:
        """Return the marker's x, y and z axes, half a side long, in the image."""
        if detection.T_cam_marker is None or self._camera is None:
            return []
        T_cam_marker = pose_matrix(detection.T_cam_marker)
        marker = self._mission.marker(detection.marker_id)
        length_m = 0.5 * (marker.side_m if marker else self._mission.default_side_m)
        ends_cam = transform(T_cam_marker, length_m * np.vstack([np.zeros(3), np.eye(3)]))
        if (ends_cam[:, 2] < 0.1 * length_m).any():
            return []
        origin, *ends = self._camera.project(ends_cam)
        return [np.stack([origin, end]) for end in ends]

    def _draw_state(self, state: RelativeState, envelope: Envelope, t_receipt_ns: int) -> None:
        self._draw_status("mode", state.mode.name)
        if envelope.stamp.t_origin_ns > 0:
            self._log("plots/latency_ms", rr.Scalars(1e-6 * (t_receipt_ns - envelope.stamp.t_origin_ns)))
        if state.nis is not None and state.nis_dof > 0:
            self._log("plots/nis/nis", rr.Scalars(state.nis / state.nis_dof))
            self._log("plots/nis/bound", rr.Scalars(chi2.ppf(NIS_BAND, state.nis_dof) / state.nis_dof))
        if state.port is not None:
            self._draw_status("corridor", "inside" if state.port.in_corridor else "outside")
        if state.T_chaser_target is None:
            return
        if not self._mission.markers and state.marker_ids and self._changed("target", state.marker_ids[0]):
            self._draw_target([(state.marker_ids[0], np.eye(4), self._mission.default_side_m, Flat())])
        self._draw_estimate(state)
        truth = self._truths.pop(envelope.stamp.sequence, None)
        if truth is not None:
            self._draw_errors(state, truth)
        else:
            _keep(self._states, envelope.stamp.sequence, state)

    def _draw_estimate(self, state: RelativeState) -> None:
        motion = self._motion(state)
        assert motion is not None and state.T_chaser_target is not None
        self._draw_chaser("estimate", pose_matrix(state.T_chaser_target), motion, ESTIMATE)
        self._draw_frustum(motion.range_m)
        covariance = None if state.covariance is None else np.reshape(state.covariance, (12, 12))
        values = (motion.range_m, 1e3 * motion.lateral_m, 1e3 * motion.closing_m_s)
        for name, value in zip(("range_m", "lateral_mm", "closing_mm_s"), values, strict=True):
            self._log(f"plots/{name}/estimate", rr.Scalars(value))
        if covariance is None:
            return
        rows = (motion.range_by, 1e3 * motion.lateral_by, 1e3 * motion.closing_by)
        for name, value, row in zip(("range_m", "lateral_mm", "closing_mm_s"), values, rows, strict=True):
            bound = SIGMAS * np.sqrt(row @ covariance @ row)
            self._log(f"plots/{name}/bound", rr.Scalars([value + bound, value - bound]))
        position, attitude = (SIGMAS * np.sqrt(np.trace(covariance[k : k + 3, k : k + 3])) for k in (0, 3))
        self._log("plots/position_error_mm/bound", rr.Scalars(1e3 * position))
        self._log("plots/attitude_error_deg/bound", rr.Scalars(np.rad2deg(attitude)))
        half_sizes, quaternion = ellipsoid(motion.jacobian @ covariance @ motion.jacobian.T, SIGMAS)
        shape = rr.Ellipsoids3D(
            centers=[motion.p_port_m],
            half_sizes=[half_sizes],
            quaternions=[quaternion],
            colors=ESTIMATE & ~0xFF | 0x60,
            fill_mode=rr.components.FillMode.Solid,
        )
        self._log("scene/estimate/ellipsoid", shape)

    def _draw_chaser(self, whose: str, T_chaser_target: Array, motion: PortMotion, color: int) -> None:
        """Move a chaser, and add the last stretch to its path."""
        self._log(f"scene/{whose}/chaser", _transform3d(chaser_pose(T_chaser_target, self._T_target_port)))
        before = self._last.get(whose, motion.p_port_m)
        self._last[whose] = motion.p_port_m
        stretch = rr.LineStrips3D([[before, motion.p_port_m]], colors=color, radii=rr.Radius.ui_points(1.5))
        self._log(f"scene/{whose}/path", stretch)

    def _draw_frustum(self, range_m: float) -> None:
        """Keep the picture in the frustum between the camera and what it looks at."""
        distance_m = float(np.clip(0.4 * range_m, 0.02, 0.3))
        if self._camera is None or abs(distance_m / self._last.get("frustum", 1e9) - 1) < 0.05:
            return
        self._last["frustum"] = distance_m
        camera = self._camera
        pinhole = rr.Pinhole(
            image_from_camera=camera.K,
            resolution=(camera.width, camera.height),
            image_plane_distance=distance_m,
            color=ESTIMATE,
            line_width=-1.0,  # negative: in points of the screen
        )
        self._log(CAMERA, pinhole)

    def _draw_truth(self, truth: Truth, envelope: Envelope, _t_ns: int) -> None:
        motion = self._motion(truth)
        assert motion is not None
        self._draw_chaser("truth", pose_matrix(truth.T_chaser_target), motion, TRUE)
        values = (motion.range_m, 1e3 * motion.lateral_m, 1e3 * motion.closing_m_s)
        for name, value in zip(("range_m", "lateral_mm", "closing_mm_s"), values, strict=True):
            self._log(f"plots/{name}/truth", rr.Scalars(value))
        state = self._states.pop(envelope.stamp.sequence, None)
        if state is not None:
            self._draw_errors(state, truth)
        else:
            _keep(self._truths, envelope.stamp.sequence, truth)

    def _draw_errors(self, state: RelativeState, truth: Truth) -> None:
        assert state.T_chaser_target is not None
        error = difference(pose_matrix(truth.T_chaser_target), pose_matrix(state.T_chaser_target))
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

    def _motion(self, of: RelativeState | Truth) -> PortMotion | None:
        if of.T_chaser_target is None:
            return None
        velocity = np.zeros(3) if of.v_chaser_target_m_s is None else vector_array(of.v_chaser_target_m_s)
        omega = of.omega_chaser_target_in_target_rad_s
        rate = np.zeros(3) if omega is None else vector_array(omega)
        return port_motion(pose_matrix(of.T_chaser_target), velocity, rate, self._T_chaser_port, self._T_target_port)


def _keep(waiting: dict[int, Any], sequence: int, message: Any) -> None:
    """Keep a message for its partner of the same frame, and forget the oldest."""
    waiting[sequence] = message
    if len(waiting) > KEPT_FRAMES:
        del waiting[next(iter(waiting))]


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


def _outlines(found: list[Detection]) -> tuple[list[Array], list[int], list[float]]:
    """Return strips, colours and radii of the layers seen; an outer square that is only predicted is dashed."""
    strips: list[Array] = []
    colors: list[int] = []
    radii: list[float] = []
    for detection in found:
        if all(seen.layer != 0 for seen in detection.layers):
            dashes = dashed(points_array(detection.corners_px))
            strips += dashes
            colors += [LAYER_COLORS[0]] * len(dashes)
            radii += [-0.75] * len(dashes)
        for seen in detection.layers:
            corners = points_array(seen.corners_px)
            strips.append(np.vstack([corners, corners[:1]]))
            colors.append(LAYER_COLORS[seen.layer])
            radii.append(-2.0)  # negative: in points of the screen
    return strips, colors, radii


def _grid_strips(detection: Detection) -> list[Array]:
    """Return the rows and columns of the grid on which a curved print was read."""
    warp = detection.warp_grid
    if warp is None:
        return []
    grid = points_array(warp.points_px).reshape(warp.rows, warp.columns, 2)
    return [*grid, *grid.transpose(1, 0, 2)]


def _blueprint(mission: Mission) -> rrb.Blueprint:
    """Return the layout: camera and scene above, status beside them, plots below."""
    start_m = mission.corridor.start_m
    plots = (
        ("range_m", "Range, port to port [m]"),
        ("lateral_mm", "Lateral offset [mm]"),
        ("closing_mm_s", "Closing speed [mm/s]"),
        ("seen", "Markers and layers seen"),
        ("position_error_mm", "Position error [mm]"),
        ("attitude_error_deg", "Attitude error [deg]"),
        ("nis", "NIS per degree of freedom"),
        ("latency_ms", "Latency, frame to state [ms]"),
    )
    past = rrb.VisibleTimeRange(
        "capture_time", start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
    by_frame = rrb.VisibleTimeRange(
        "frame", start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
    ranges = rrb.archetypes.VisibleTimeRanges([past, by_frame])

    def scene(name: str, position: tuple[float, float, float], target: tuple[float, float, float]) -> rrb.Spatial3DView:
        return rrb.Spatial3DView(
            origin="scene",
            contents=["$origin/**", f"- {OVERLAY}/**"],
            name=name,
            background=[18, 20, 26],
            line_grid=False,
            eye_controls=rrb.EyeControls3D(position=position, look_target=target, eye_up=(0.0, 1.0, 0.0)),
            overrides={path: ranges for path in PATHS},
        )

    wide = scene("Approach", (0.95 * start_m, 0.55 * start_m, 0.9 * start_m), (0.0, 0.0, 0.42 * start_m))
    near = scene("Close-up", (0.35 * start_m, 0.2 * start_m, 0.32 * start_m), (0.0, 0.0, 0.06 * start_m))
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial2DView(origin=CAMERA, name="Camera", background=[0, 0, 0]),
                rrb.Tabs(wide, near),
                rrb.Vertical(
                    rrb.TextDocumentView(origin="legend", name="What you see"),
                    rrb.StateTimelineView(origin="status", name="Status"),
                    rrb.TextLogView(origin="events", name="Events"),
                    row_shares=[0.42, 0.28, 0.3],
                ),
                column_shares=[0.42, 0.36, 0.22],
            ),
            rrb.Grid(
                *(rrb.TimeSeriesView(origin=f"plots/{name}", name=title) for name, title in plots), grid_columns=4
            ),
            row_shares=[0.54, 0.46],
        ),
        rrb.TimePanel(state="collapsed", timeline="capture_time"),
        collapse_panels=True,
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
        process = subprocess.Popen(
            [*VIEWER_COMMAND, *options], stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True
        )
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
