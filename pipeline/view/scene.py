"""The three-dimensional scene's fixed parts: the target with its markers, the corridor, a chaser's hull."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from astratag.artwork import artwork_image
from astratag.dictionary import Dictionary
from astratag.geometry import QUIET_MARGIN
from astratag.surface import Surface
from pipeline.mission import CorridorSection
from pipeline.view.geometry import (
    Mesh,
    corridor_mesh,
    corridor_strips,
    hold_point_strips,
    keep_out_strips,
    print_mesh,
    target_bodies,
)
from pipeline.view.layout import ALARM_COLOR, BODY_COLOR, CORRIDOR_COLOR, SCENE, faint

Array = NDArray[np.float64]
Log = Callable[..., None]
"""Draws under a path: ``log(path, *archetypes, static=False)``."""
Mounted = tuple[int, Array, float, Surface]
"""A marker on the target: id, T_target_marker, side in metres, surface."""

LARGEST_SPHERE = 5.0
"""A keep-out sphere is drawn when its radius is at most so many lengths of the corridor: the scene stays in sight."""
CHASER_M = (0.11, 0.11, 0.13)
"""The chaser as drawn: width, height, and depth behind its docking port."""


def transform3d(T_a_b: Array) -> rr.Transform3D:
    """Return a transform as Rerun draws it: the pose of b in a."""
    return rr.Transform3D(translation=T_a_b[:3, 3], mat3x3=T_a_b[:3, :3])


def draw_target(log: Log, markers: Sequence[Mounted], dictionary: Dictionary) -> None:
    """Draw the markers with their artwork, and the bodies under them."""
    for k, (T_target_body, mesh) in enumerate(target_bodies([marker[1:] for marker in markers])):
        log(f"{SCENE}/target/body_{k}", transform3d(T_target_body), _mesh3d(mesh, color=BODY_COLOR), static=True)
    for marker_id, T_target_marker, side_m, surface in markers:
        artwork = artwork_image(dictionary.signature(marker_id))
        margin = round(QUIET_MARGIN * len(artwork))
        texture = np.pad(artwork, margin, constant_values=255)[::2, ::2, None].repeat(3, axis=2)
        drawn = _mesh3d(print_mesh(side_m, surface), texture=texture)
        log(f"{SCENE}/target/marker_{marker_id}", transform3d(T_target_marker), drawn, static=True)


def draw_corridor(log: Log, corridor: CorridorSection, T_target_port: Array) -> None:
    """Draw the approach corridor as a veil with edges, its hold points, and a keep-out sphere of a like size."""
    veil = _mesh3d(corridor_mesh(corridor), color=faint(CORRIDOR_COLOR, 0x18))
    edges = rr.LineStrips3D(
        corridor_strips(corridor), colors=faint(CORRIDOR_COLOR, 0x90), radii=rr.Radius.ui_points(0.6)
    )
    log(f"{SCENE}/corridor", veil, static=True)
    log(f"{SCENE}/corridor/edges", edges, static=True)
    thin: dict[str, Any] = {"colors": faint(CORRIDOR_COLOR, 0xD0), "radii": rr.Radius.ui_points(1.0)}
    if corridor.hold_points_m:
        log(f"{SCENE}/corridor/hold_points", rr.LineStrips3D(hold_point_strips(corridor), **thin), static=True)
    if 0 < corridor.keep_out_radius_m <= LARGEST_SPHERE * corridor.start_m:
        sphere = rr.LineStrips3D(keep_out_strips(corridor, T_target_port), colors=faint(ALARM_COLOR, 0x60))
        log(f"{SCENE}/keep_out_sphere", sphere, static=True)


def draw_vehicle(log: Log, path: str, T_chaser_port: Array, *, color: int, width: float, size: float = 1.0) -> None:
    """Draw a chaser's hull in its own frame and style its path, in lines of ``width`` points of the screen."""
    half_m = size * np.array(CHASER_M) / 2
    radius = rr.Radius.ui_points(width)
    hull = rr.Boxes3D(
        centers=[(0.0, 0.0, -CHASER_M[2] / 2)],
        half_sizes=[half_m],
        colors=color,
        radii=radius,
        fill_mode=rr.components.FillMode.MajorWireframe,
    )
    log(f"{path}/chaser/hull", transform3d(T_chaser_port), hull, static=True)
    log(f"{path}/path", rr.LineStrips3D.from_fields(colors=[color], radii=radius), static=True)


def _mesh3d(mesh: Mesh, *, color: int | None = None, texture: NDArray[np.uint8] | None = None) -> rr.Mesh3D:
    return rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.triangles,
        vertex_normals=mesh.normals,
        vertex_texcoords=mesh.texture,
        albedo_factor=color,
        albedo_texture=texture,
    )
