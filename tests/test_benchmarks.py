"""A cell of every kind of the benchmarks runs, and the peers' artwork and corners are where they should be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from astratag import Detection, PlanarPose
from astratag.signature import BLUR_UNITS, BLURRED_CELLS, EFFECTIVE_SHARE
from astratag.transforms import exp_so3, pose
from benchmarks.detection import clutter
from benchmarks.detection.cost import SCENES, measure_cost
from benchmarks.detection.covariance import Consistency, band, information_of, marker_in, measure_covariance
from benchmarks.detection.false_accepts import measure_effective_cells, measure_false_accepts
from benchmarks.detection.figures import draw_condition, draw_cost, draw_covariance
from benchmarks.detection.peers import ENTRANTS, MARKERS, TRACKED, Entrant, texture
from benchmarks.detection.profile import measure_profile
from benchmarks.detection.recall import SIZES, measure, wilson
from benchmarks.detection.scenes import CONDITIONS, SHEET_M, Scene, draw
from benchmarks.filter.__main__ import SMALL, consistency, plot
from benchmarks.filter.simulate import simulate

SEED = 5
QUICK = tuple(entrant for entrant in ENTRANTS if entrant.needs in ("astratag", "cv2"))
EASY = Scene(side_px=150, tilt_deg=(0, 20))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("entrant", ENTRANTS, ids=lambda entrant: entrant.name)
def test_reads_its_own_print_where_it_was_laid(entrant: Entrant, size: str):
    if entrant.absent:
        pytest.skip(f"{entrant.needs} is not installed; make setup EXTRAS=peers")
    kind, scene = MARKERS[entrant.marker], draw(EASY, SEED)
    printed = 3 % kind.ids
    seen = entrant.start(scene.surface)(scene.photograph(texture(entrant.marker, printed, size)), scene.camera)
    truth = kind.corners(printed, size)
    assert seen
    for identity, corners in seen:
        assert np.abs(corners - scene.pixels(truth[identity])).max() < 1.5


def test_sheets_are_as_wide_as_astratags_on_equal_area():
    assert {kind.sheet_m("equal") for kind in MARKERS.values()} == {SHEET_M}
    assert MARKERS["AstraTag"].sheet_m("nominal") == pytest.approx(SHEET_M)
    assert MARKERS["tagCustom48h12"].sheet_m("nominal") == pytest.approx(0.1667, abs=1e-4)


@pytest.mark.parametrize("condition", CONDITIONS, ids=lambda condition: condition.name)
def test_a_cell_of_each_condition(condition, tmp_path):
    rows = measure(condition.name, condition.values[0], 2, [entrant.name for entrant in QUICK])
    assert {row["entrant"] for row in rows} == {entrant.name for entrant in QUICK}
    for row in rows:
        assert row["images"] == 2
        assert row["recall_95"][0] <= row["recall"] <= row["recall_95"][1]
    assert draw_condition(condition, rows, tmp_path).stat().st_size > 0


def test_covariances_of_a_cell_are_looked_at_beside_their_band(tmp_path):
    rows = measure_covariance("tilt", 30, 2)
    assert [row["surface"] for row in rows] == ["told", "unknown"]
    for row in rows:
        assert row["poses"] == 2 and row["other_pose"] == 0
        assert row["nees_95"] == pytest.approx(band(2))
        assert 0 < row["nees"] < 5
        assert row["bounded"] == 1 and 0.5 < row["times_bound"] < 50
    assert draw_covariance(rows, tmp_path).stat().st_size > 0


def test_a_pose_whose_mirror_image_was_the_right_one_is_counted_apart():
    true, mirrored = (pose(exp_so3([0.0, tilt, 0.0]), [0.0, 0.0, 1.0]) for tilt in (0.3, -0.3))
    planar = PlanarPose(mirrored, 0.02, 0.7), PlanarPose(true, 0.02, 0.3)
    seen = Detection("astratag", 3, np.zeros((4, 2)), (), 1.0, 0, "planar", planar, mirrored, np.eye(6))
    cell = Consistency()
    cell.add(seen, true)
    cell.add(replace(seen, T_cam_marker=true, planar_poses=planar[1:]), true)
    assert (cell.other_pose, cell.other_pose_expected, cell.nees) == (1, pytest.approx(0.3), [pytest.approx(0.0)])


def test_the_same_seed_draws_the_same_picture():
    print_ = texture("AstraTag", 3, "equal")
    first, again, other = (draw(EASY, seed).photograph(print_) for seed in (SEED, SEED, SEED + 1))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_cost_of_two_frames(tmp_path):
    rows = measure_cost(2, (*QUICK, TRACKED))
    assert all(row["cpu_ms"] > 0 and row["found"] == 2 for row in rows)
    assert draw_cost(rows, tmp_path).stat().st_size > 0


def test_pictures_without_a_marker_are_timed_beside_a_plain_one(monkeypatch):
    monkeypatch.setattr(clutter, "SCENES", {"320x240": SCENES["320x240"]})
    monkeypatch.setattr(clutter, "TURNS", 1)
    for row in clutter.measure_clutter(QUICK[:1]):
        assert row["plain_ms"] > 0 and row["median_times"] <= row["worst_times"]
        assert row["worst"] in dict(clutter.clutter(draw(SCENES["320x240"], SEED)))


def test_a_profile_divides_the_time_of_a_search():
    for row in measure_profile(1):
        assert {"integral", "resize"} <= set(row["OpenCV"])
        assert {"threshold_blocks", "traced", "_measured", "_solved"} <= set(row["compiled"])
        assert sum(row["OpenCV"].values()) + sum(row["compiled"].values()) > 0


def test_false_accepts_count_what_the_search_proposes():
    result = measure_false_accepts(100, None, QUICK[:1])
    assert result["candidates"] >= 100
    assert result["entrants"][0]["reports"] == 0


def test_cells_of_texture_are_worth_what_the_detector_takes_them_for():
    measured = measure_effective_cells(25, None)
    assert measured["quads"] > 1000
    for width, cells in zip(BLUR_UNITS, BLURRED_CELLS, strict=True):
        assert measured[f"blur {width:g} units"] > 0.9 * EFFECTIVE_SHARE * cells


@pytest.mark.parametrize(("found", "images", "low", "high"), [(0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0)])
def test_wilson_bounds_against_the_closed_form(found, images, low, high):
    assert wilson(found, images) == pytest.approx((low, high), abs=1e-4)


def test_a_short_flight_of_the_filter_benchmark_is_at_its_bound(tmp_path):
    """Four seconds from 0.5 m on, two runs: NEES near 1, and RMS not far from the bound, for so few."""
    case = replace(SMALL, ranges_m=(0.5, 0.4, 0.3), duration_s=4.0, limits=(1.15, 1.15))
    samples = simulate(case, 2, first_seed=SEED)
    rms, bound = (np.sqrt(np.mean(values, axis=0)) for values in (samples.squares, samples.bounds))
    assert (rms < 2.5 * bound).all()
    assert 0.4 < np.mean(samples.nees) / 12 < 2
    assert "NEES" in consistency(case, samples, 2)
    plot([(case, samples)], tmp_path / "filter.png")
    assert (tmp_path / "filter.png").stat().st_size > 0


def test_the_bound_is_of_how_the_picture_of_a_moving_print_changes():
    """Square-on, a print that moves sideways shifts: its slopes are the picture's own, found by another way."""
    one, print_ = draw(Scene(side_px=120, tilt_deg=(0, 0)), 5), texture("AstraTag", 7, "equal")
    picture = one.expected(print_, 16)
    pixels_a_metre = one.camera.K[0, 0] / one.T_cam_print[2, 3]
    waves = [2j * np.pi * np.fft.fftfreq(n) for n in picture.shape]
    spectrum = np.fft.fft2(picture)
    down, right = (np.fft.ifft2(spectrum * wave).real for wave in (waves[0][:, None], waves[1]))
    x, y, _ = one.T_cam_print[:3, 0]
    slopes = pixels_a_metre * (x * right + y * down)[marker_in(one)]
    assert information_of(one, print_)[0, 0] == pytest.approx(slopes @ slopes / one.scene.noise_sigma**2, rel=0.05)
