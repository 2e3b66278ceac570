"""Locating edges: points far apart are the mean of several rows, and blur moves edges that look curved inwards."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from astratag import Camera, Cylinder, Detector, Flat, Surface, load_dictionary
from astratag.edges import template_of
from astratag.grow import ALL_EDGES
from astratag.locate import CLOSE_PX, MOST_ROWS, ROW_PX, Edges, locate
from astratag.pulls import quieter
from astratag.transforms import exp_so3, pose
from astratag.warp import PoseWarp
from pipeline.render import render_marker

CAMERA = Camera([[600, 0, 159.5], [0, 600, 159.5], [0, 0, 1]], width=320, height=320)
FACING = np.diag([1.0, -1.0, -1.0])
SIGNATURE, SIDE_M = load_dictionary().signature(7), 0.1
OUTER = slice(0, 4)


def located(
    T_cam_marker: NDArray[np.float64], surface: Surface, noise_sigma: float, search_px: float, seed: int = 0
) -> Edges:
    """Return where all edges are found in a picture, looked for from where they are."""
    image = render_marker(
        CAMERA,
        T_cam_marker,
        signature=SIGNATURE,
        side_m=SIDE_M,
        surface=surface,
        noise_sigma=noise_sigma,
        seed=seed,
        samples=64,
    )
    light = Detector(side_m=SIDE_M).view(image, CAMERA).light
    warp, template = PoseWarp(CAMERA, SIDE_M, surface, T_cam_marker), template_of(ALL_EDGES)
    return locate(*light, warp(template.probes), warp.visible(template.few), *template[3:], search_px)


def test_rows_and_a_wide_filter_quieten_long_edges_with_room_beside_them() -> None:
    """A side of 240 px: points are 10 px apart, so each is the mean of five rows, all as far as neighbours allow."""
    T_cam_marker, spread = pose(FACING @ exp_so3([0.1, 0.15, 0.4]), [0.0, 0.0, 0.25]), {}
    for search_px in (CLOSE_PX, 1.5 * CLOSE_PX):
        seen = [located(T_cam_marker, Flat(), 8.0, search_px, seed) for seed in range(3)]
        spread[search_px] = np.std([one.offset_px[OUTER] for one in seen])
    alone, several = spread[1.5 * CLOSE_PX], spread[CLOSE_PX]
    assert (seen[0].rows == 1).all()
    close = located(T_cam_marker, Flat(), 8.0, CLOSE_PX)
    assert (close.rows[OUTER] == MOST_ROWS).all()
    gain = quieter(seen[0].lens_px, close.smoothing_px[0])
    assert gain > 1.25
    assert several == pytest.approx(alone / np.sqrt(MOST_ROWS) / gain, rel=0.15)


def test_rows_are_as_far_apart_as_their_points_allow() -> None:
    """And edges beside which others are near are looked at in one."""
    seen = located(pose(FACING, [0.0, 0.0, 0.6]), Flat(), 0.0, CLOSE_PX)
    assert (seen.rows[4:] == 1).all()
    assert (seen.rows[OUTER] == 2).all()
    np.testing.assert_allclose(seen.beside_px[OUTER] ** 2 - seen.beside_px[4] ** 2, ROW_PX**2 / 4)


def test_edges_that_look_curved_are_where_they_are() -> None:
    """Sides that run around a cylinder turned far away; uncorrected they are 0.008 px inside."""
    T_cam_marker = pose(FACING @ exp_so3([0, 0, 0.3]) @ exp_so3([0, np.radians(60), 0]), [0.0, 0.0, 0.35])
    seen = located(T_cam_marker, Cylinder(0.15, np.pi / 2), 0.0, 1.5 * CLOSE_PX)
    around = [0, 2]
    assert seen.found[around].all()
    turned = np.arccos(np.clip((seen.normal[:, around, 0] * seen.normal[:, around, -1]).sum(axis=0), -1, 1))
    assert turned.min() > 0.3
    assert abs(seen.offset_px[around].mean()) < 0.003
