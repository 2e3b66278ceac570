"""Bad input to the library is refused in one line that teaches; images of any kind are not bad input."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from astratag import (
    Camera,
    Cylinder,
    Detection,
    Detector,
    Dictionary,
    Flat,
    MarkerSpec,
    Tracker,
    annotate,
    load_dictionary,
    write_dictionary,
)
from astratag.artwork import artwork_image, write_artwork
from astratag.codes import (
    FAMILIES,
    acceptance_threshold,
    effective_cells,
    hamming_false_accept_rate,
    hamming_threshold,
    search_instance,
    select_identities,
)
from astratag.geometry import MarkerGeometry
from astratag.transforms import exp_so3, pose
from pipeline.render import render_marker

NAN, INF = float("nan"), float("inf")
K = np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])
CAMERA = Camera(K, width=320, height=240)
BLACK = np.zeros((240, 320), np.uint8)
TWENTY = load_dictionary()
CODES = TWENTY.signatures
FAMILY = FAMILIES["astratag48h16"]
DETECTOR = Detector()
TRACKER = Tracker(DETECTOR)
NO_LENGTHS = (0, -0.1, NAN, INF, None, "0.1", [0.1], 1j, True, np.array([0.1, 0.2]), 10**400)


def k(row: int, column: int, value: float) -> np.ndarray:
    changed = K.copy()
    changed[row, column] = value
    return changed


def camera(K: Any = K, distortion: Any = (), width: Any = 320, height: Any = 240) -> Camera:
    return Camera(K, distortion, width=width, height=height)


Refused = tuple[str, str, Callable[[], object]]
"""A name, what the message says, and the call."""

NO_CAMERAS: list[Refused] = [
    *((f"K {i}", "K must be finite", lambda bad=bad: camera(bad)) for i, bad in enumerate(
        (None, "abc", {}, k(0, 0, NAN), k(0, 2, INF), [[1, 2], [3]], K * 1j, [[object()] * 3] * 3, [[10**400] * 3] * 3)
    )),
    *((f"K shape {i}", "K must be 3x3 with last row 0 0 1", lambda bad=bad: camera(bad)) for i, bad in enumerate(
        ([], [1, 2, 3], np.eye(4), np.zeros((3, 3)), K.T, 2 * K, k(2, 0, 0.1), k(2, 2, 0))
    )),
    *((f"K singular {i}", "positive focal lengths in pixels", lambda bad=bad: camera(bad)) for i, bad in enumerate(
        (k(0, 0, 0), k(1, 1, 0), k(1, 1, -300), k(0, 0, 0.004), np.eye(3), k(0, 0, 1e300), k(0, 2, -1e300))
    )),
    ("skew", "no skew", lambda: camera(k(0, 1, 3.0))),
    *((f"distortion {i}", "distortion must be", lambda bad=bad: camera(distortion=bad)) for i, bad in enumerate(
        (None, "x", 0.1, [0] * 3, [0] * 8, [NAN] * 5, [0, 0, 0, 0, INF], [1j] * 5, [[1], [1, 2]])
    )),
    *((f"width {bad!r}", "width must be a whole number, 1 or more", lambda bad=bad: camera(width=bad)) for bad in (
        0, -320, NAN, INF, None, "320", 320.5, True, [320]
    )),
    *((f"scaled {bad!r}", "width must be a whole number", lambda bad=bad: CAMERA.scaled(bad, 240)) for bad in (
        0, -1, NAN, INF, None, "320"
    )),
    *((f"camera file {bad!r}", "camera file|path must be", lambda bad=bad: Camera.load(bad)) for bad in (
        None, 5, "", "no/such.json", "x" * 5000
    )),
    ("camera path null", "null byte", lambda: Camera.load("a\0b")),
]  # fmt: skip

NO_MARKERS: list[Refused] = [
    *((f"detector side {i}", "side_m must be a positive length", lambda bad=bad: Detector(side_m=bad))
        for i, bad in enumerate(NO_LENGTHS)),
    *((f"spec side {i}", "side_m must be a positive length", lambda bad=bad: MarkerSpec(bad))
        for i, bad in enumerate(NO_LENGTHS)),
    *((f"radius {i}", "radius_m must be a positive length", lambda bad=bad: Cylinder(bad))
        for i, bad in enumerate(NO_LENGTHS)),
    *((f"axis {i}", "axis_rad must be a finite number", lambda bad=bad: Cylinder(0.1, bad))
        for i, bad in enumerate((NAN, INF, None, "0", [0.0], 1j))),
    *((f"contraction {i}", "contraction must be", lambda bad=bad: MarkerGeometry(contraction=bad))
        for i, bad in enumerate((*NO_LENGTHS, 1.0, 2))),
    *((f"border {i}", "border", lambda bad=bad: MarkerGeometry(border=bad))
        for i, bad in enumerate((*NO_LENGTHS, 0.1))),
    *((f"layers {bad!r}", "layers", lambda bad=bad: MarkerGeometry(layers=bad))
        for bad in (0, -1, 1.5, "3", None, 8, 10**9)),
    ("more than once around", "goes more than once around", lambda: MarkerSpec(0.1, Cylinder(0.015))),
    *((f"surface {bad!r}", "surface must be Flat", lambda bad=bad: Detector(surface=bad)) for bad in (
        "flat", Flat, Cylinder, 0.15, []
    )),
    *((f"markers id {bad!r}", r"marker .* is not in dictionary 'astratag20' \(ids 0-19\)",
        lambda bad=bad: Detector(markers={bad: MarkerSpec(0.1)})) for bad in (20, -1, "0", 1.5, 1.0, NAN, None)),
    *((f"markers {bad!r}", "markers", lambda bad=bad: Detector(markers=bad)) for bad in (
        [3], {3}, "19", 3, {0: 0.1}, {0: (0.1, Flat())}, {0: None}
    )),
    *((f"transfer {bad!r}", "transfer must be 'srgb' or 'linear'", lambda bad=bad: Detector(transfer=bad)) for bad in (
        "gamma", None, ["srgb"], 2.2
    )),
    *((f"dictionary {bad!r}"[:40], "dictionary", lambda bad=bad: Detector(bad)) for bad in (
        "astratag36h11", None, 4, [1], b"astratag20", "", "x" * 5000, "a\0b", "astratag20:20", "astratag20:-1",
        "astratag20:1,1", "astratag20:9-3", "astratag20:a", "astratag20:"
    )),
    ("family too large", "name those in use", lambda: Detector("astratag48h9")),
]  # fmt: skip

NO_IDS: list[Refused] = [
    *((f"ids {bad!r} of {name}", "ids|marker|lists an id twice|holds no markers",
        lambda bad=bad, name=name: load_dictionary(name, ids=bad))
        for name in ("astratag20", "astratag48h12")
        for bad in ([], [-1], [10**30], [4, 4], [1.0], ["1"], [NAN], [None], [[1]], 5, "12")),
    *((f"signature {bad!r}", "marker .* is not in dictionary", lambda bad=bad: TWENTY.signature(bad))
        for bad in (20, -1, 1.0, "1", None, NAN, [1])),
    *((f"family {bad!r}", "astratag48h16 has ids 0-1007", lambda bad=bad: FAMILY.signatures(bad))
        for bad in (1008, -1, 1.0, "1", None, [None], [10**30], [True])),
    *((f"write id {bad!r}", "marker .* is not in dictionary",
        lambda bad=bad: write_artwork(TWENTY, bad, "never.svg", side_m=0.1)) for bad in (20, -1, 1.5, "1", None)),
    *((f"select {bad!r}", "count must be", lambda bad=bad: select_identities(FAMILY, bad))
        for bad in (0, 1009, 1.5, "2", None, NAN)),
    *((f"search k {bad!r}", "k must be", lambda bad=bad: search_instance(bad, 0)) for bad in (1, 2.5, "2", None, [2])),
]  # fmt: skip

NO_DICTIONARIES: list[Refused] = [
    (name, message, lambda ids=ids, cells=cells: Dictionary("bad", ids, cells)) for name, message, ids, cells in (
        ("alike", "colliding", (0, 1), CODES[[0, 0]]),
        *((f"alike turned {turns}", "colliding", (0, 1), np.stack([CODES[0], TWENTY.oriented[0, turns]]))
            for turns in (1, 2, 3)),
        ("looks the same turned", "colliding", (0,), np.zeros((1, 48))),
        ("no ids", "holds no markers", (), np.zeros((0, 48))),
        ("an id twice", "lists an id twice", (3, 3), CODES[:2]),
        ("negative id", "outside of 0-", (-1,), CODES[:1]),
        ("huge id", "outside of 0-", (10**30,), CODES[:1]),
        *((f"ids {bad!r}", "ids must be", bad, CODES[:1]) for bad in
            (5, None, ("a",), (1.5,), (None,), (NAN,), ([1],))),
        ("rows", r"must be \(1, 48\), got \(2, 48\)", (0,), CODES[:2]),
        ("47 cells", r"must be \(1, 48\), got \(1, 47\)", (0,), CODES[:1, :47]),
        ("one dimension", r"must be \(1, 48\), got \(48,\)", (0,), CODES[0]),
        *((f"cells {i}", "neither 0 nor 1|signatures must be", (0,), bad)
            for i, bad in enumerate((CODES[:1] * 2, CODES[:1] * 0.5, CODES[:1] * NAN, None, "abc", [[1, 0], [1]]))),
    )
]  # fmt: skip

NO_PICTURES = {
    "none": None,
    "list": [[0]],
    "path": "frame.png",
    "empty": np.zeros((0, 0), np.uint8),
    "no columns": np.zeros((240, 0), np.uint8),
    "no rows of colour": np.zeros((0, 320, 3), np.uint8),
    "one dimension": np.zeros(320, np.uint8),
    "no dimension": np.array(3, np.uint8),
    "one channel": np.zeros((240, 320, 1), np.uint8),
    "two channels": np.zeros((240, 320, 2), np.uint8),
    "four channels": np.zeros((240, 320, 4), np.uint8),
    "a batch": np.zeros((1, 240, 320, 3), np.uint8),
    **{str(kind): np.zeros((240, 320), kind) for kind in ("float64", "uint16", "int8", "bool", "object")},
}
NO_IMAGES: list[Refused] = [
    (f"{where} {name}", "image must be", lambda look=look, bad=bad: look(bad))
    for name, bad in NO_PICTURES.items()
    for where, look in (
        ("detector", DETECTOR.detect),
        ("detector with camera", lambda image: DETECTOR.detect(image, CAMERA)),
        ("tracker", TRACKER.detect),
        ("annotate", lambda image: annotate(image, [])),
    )
]  # fmt: skip

NO_ARGUMENTS: list[Refused] = [
    *((f"{where} of {bad!r}"[:60], "camera must be a Camera", lambda look=look, bad=bad: look(BLACK, bad))
        for where, look in (("detector", DETECTOR.detect), ("tracker", TRACKER.detect))
        for bad in ("camera.json", K, {}, Camera)),
    ("another size", "the calibration is for 320x240, the images are 640x480",
        lambda: DETECTOR.detect(np.zeros((480, 640), np.uint8), CAMERA)),
    ("tracker of another size", "the calibration is for 320x240", lambda: TRACKER.detect(BLACK.T, CAMERA)),
    *((f"tracker of {bad!r}"[:40], "detector must be a Detector", lambda bad=bad: Tracker(bad))
        for bad in (None, "astratag20", TWENTY, Detector)),
    *((f"annotate {bad!r}", "detections must be", lambda bad=bad: annotate(BLACK, bad))
        for bad in (None, "ab", [1], 3)),
    ("annotate side", "side_m must be", lambda: annotate(BLACK, [], CAMERA, side_m=NAN)),
    ("annotate camera", "images are 64x48", lambda: annotate(BLACK[:48, :64], [], CAMERA, side_m=0.1)),
    *((f"cells {i}", "cells must be", lambda bad=bad, decoder=decoder: decoder.decode(bad))
        for decoder in (TWENTY, FAMILY)
        for i, bad in enumerate((None, "a", np.zeros(47), np.zeros((1, 48)), [NAN] * 48, [None] * 48, [1j] * 48))),
    *((f"bits {i}", "cells must be 48 zeros and ones", lambda bad=bad, read=read: read(bad))
        for read in (FAMILY.correct, FAMILY.identify)
        for i, bad in enumerate((None, "a", np.zeros(47, int), np.full(48, 2), np.zeros(48), [-1] * 48))),
    *((f"erased {i}", "erased must be 8 booleans", lambda bad=bad, decode=decode: decode(CODES[0], bad))
        for decode in (TWENTY.decode, FAMILY.decode, FAMILY.correct)
        for i, bad in enumerate(([True] * 7, [1] * 8, "a", [None] * 8))),
    *((f"threshold {bad!r}", "threshold must be", lambda bad=bad: TWENTY.decode(CODES[0], threshold=bad))
        for bad in (NAN, INF, "a", [1])),
    *((f"most_missing {bad!r}", "most_missing must be", lambda bad=bad: FAMILY.decode(CODES[0], most_missing=bad))
        for bad in (-1, 8, 1.5, "a", None)),
    *((f"artwork {i}", "signature must", lambda bad=bad: artwork_image(bad))
        for i, bad in enumerate((None, "a", np.zeros(47), np.full(48, 2), np.full(48, NAN), [None] * 48))),
    *((f"write_artwork side {i}", "side_m must be", lambda bad=bad: write_artwork(TWENTY, 0, "never.svg", side_m=bad))
        for i, bad in enumerate(NO_LENGTHS)),
    *((f"write_artwork to {bad!r}", "path must|artwork format",
        lambda bad=bad: write_artwork(TWENTY, 0, bad, side_m=0.1)) for bad in (None, 5, "a", "a.gif")),
    ("write_artwork of a name", "dictionary must be a Dictionary",
        lambda: write_artwork("astratag20", 0, "never.svg", side_m=0.1)),  # type: ignore[arg-type]
    *((f"write_dictionary side {i}", "side_m must be", lambda bad=bad: write_dictionary(TWENTY, "never.json", bad))
        for i, bad in enumerate(NO_LENGTHS)),
    *((f"templates {bad!r}", "templates must be", lambda bad=bad: acceptance_threshold(bad))
        for bad in (0, NAN, 1.5, "a", None)),
    *((f"rate {bad!r}", "false_accept_rate", lambda bad=bad: hamming_threshold(80, 1, bad))
        for bad in (0, 1, NAN, INF, "a", None)),
    ("tau", "tau must be", lambda: hamming_false_accept_rate(-1, 80)),
    *((f"best {i}", "best must be", lambda bad=bad: effective_cells(bad, 80))
        for i, bad in enumerate((0.5, None, np.zeros(5000), np.full(5000, NAN), np.full(5000, 2.0)))),
]  # fmt: skip

REFUSED = [*NO_CAMERAS, *NO_MARKERS, *NO_IDS, *NO_DICTIONARIES, *NO_IMAGES, *NO_ARGUMENTS]


@pytest.mark.parametrize(("message", "call"), [row[1:] for row in REFUSED], ids=[row[0] for row in REFUSED])
def test_bad_input_is_a_value_error_of_one_line(
    message: str, call: Callable[[], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And nothing is written."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message) as error:
        call()
    assert type(error.value) is ValueError
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_numbers_of_any_kind_are_taken_for_what_they_are() -> None:
    """A width that a video file gives as 320.0, a count or a side from an array."""
    assert camera(width=320.0, height=np.int32(240)).width == 320
    assert MarkerGeometry(layers=2.0) == MarkerGeometry(layers=np.int64(2))  # type: ignore[arg-type]
    assert select_identities(FAMILY, np.int64(3)) == select_identities(FAMILY, 3.0)  # type: ignore[arg-type]
    assert TWENTY.decode(CODES[4] * 80.0, most_missing=np.int8(1)) == TWENTY.decode(CODES[4].tolist())
    assert MarkerSpec(np.float32(0.125)) == MarkerSpec(0.125)  # type: ignore[arg-type]


ENTRY = {"0": {"signature": "".join(map(str, CODES[0]))}}


def entries(key: str = "0", **changed: Any) -> str:
    return json.dumps({key: ENTRY | changed})


@pytest.mark.parametrize(
    "text",
    [
        *("", "{", "[]", "[1]", "null", "3", '"ab"', "{}", "[" * 100_000),
        *(json.dumps({"0": bad}) for bad in (None, 1, "a", [], {}, {"90": ENTRY["0"]}, {"0": None}, {"0": {}})),
        *(
            json.dumps({"0": {"0": {"signature": bad}}})
            for bad in (None, 5, "", "01", "0" * 49, "x" * 48, "2" * 48, [0.5] * 48, [[0] * 48], [NAN] * 48, [300] * 48)
        ),
        entries("a"),
        entries("-1"),
        entries("1.5"),
        entries(" 1"),
        entries("9" * 30),
        entries("9" * 5000),
        json.dumps({"0": ENTRY, "1": ENTRY}),
        json.dumps({"0": ENTRY, "1": {"0": {"signature": "".join(map(str, TWENTY.oriented[0, 1]))}}}),
        f'{{"0": {json.dumps(ENTRY)}, "0": {json.dumps(ENTRY)}}}',
        json.dumps({"0": ENTRY | {"90": ENTRY["0"]}}),
        json.dumps({"0": ENTRY | {"90": {"signature": "01"}}}),
    ],
    ids=lambda text: text[:50],
)
def test_a_broken_dictionary_file_is_refused_by_name(text: str, tmp_path: Path) -> None:
    path = tmp_path / "broken.json"
    path.write_text(text)
    for load in (load_dictionary, Detector):
        with pytest.raises(ValueError, match=r"broken\.json|'broken'") as error:
            load(path)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"\x89PNG\r\n", b"\x00" * 10])
def test_what_is_no_text_or_no_file_is_no_dictionary(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "binary.json"
    path.write_bytes(content)
    for bad in (path, tmp_path, tmp_path / "none.json"):
        with pytest.raises(ValueError, match="dictionary"):
            load_dictionary(bad)


@pytest.mark.parametrize(
    "text",
    [
        *("", "{", "[]", "null", "3", "[" * 100_000),
        *(json.dumps({"camera_matrix": bad}) for bad in (None, "x", [1, 2], {}, {"data": [1]}, [[1] * 3] * 3)),
        '{"camera_matrix": [[NaN, 0, 0], [0, 1, 0], [0, 0, 1]]}',
        '{"camera_matrix": [[300, 0, Infinity], [0, 300, 3], [0, 0, 1]]}',
        '{"camera_matrix": [[300, 0, -9], [0, 300, -9], [0, 0, 1]]}',
        *(json.dumps({"camera_matrix": K.tolist(), "distortion_coefficients": bad}) for bad in (None, "a", [1, 2, 3])),
        *(
            json.dumps({"camera_matrix": K.tolist(), "image_width": w, "image_height": 9})
            for w in (None, "a", -5, 1e400)
        ),
    ],
    ids=lambda text: text[:50],
)
@pytest.mark.parametrize("suffix", ["json", "yaml"])
def test_a_broken_camera_file_is_refused_by_name(text: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"broken.{suffix}"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"broken\.") as error:
        Camera.load(path)
    assert "\n" not in str(error.value)


# --- images of any kind


SEARCHERS = (Detector(), Detector(surface=Flat()), Detector("astratag48h16", surface=Cylinder(0.15)))


def assert_finite(found: list[Detection]) -> None:
    """Nothing in a detection is infinite or no number, and its covariance is one."""
    for seen in found:
        parts = [seen.corners_px, np.array([seen.correlation]), *(layer.corners_px for layer in seen.layers)]
        parts += [np.array([layer.sigma_px]) for layer in seen.layers]
        parts += [planar.T_cam_marker for planar in seen.planar_poses]
        maybe = (seen.T_cam_marker, seen.covariance, seen.warp_grid_px, seen.reprojection_rms_px)
        parts += [np.asarray(part) for part in maybe if part is not None]
        assert all(np.isfinite(part).all() for part in parts)
        if seen.covariance is not None:
            sigma = np.sqrt(np.diag(seen.covariance))
            assert np.linalg.eigvalsh(seen.covariance / np.outer(sigma, sigma)).min() > 0


def look(image: np.ndarray, searchers: tuple[Detector, ...] = SEARCHERS) -> None:
    """Search an image with and without memory and camera."""
    height, width = image.shape[:2]
    focal_px = max(height, width)
    matrix = [[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]]
    camera = Camera(matrix, (-0.3, 0.1, 0.001, 0, 0), width=width, height=height)
    for detector in searchers:
        tracker = Tracker(detector)
        for found in (detector.detect(image), tracker.detect(image, camera), tracker.detect(image, camera)):
            assert_finite(found)


def patterns(rows: int, columns: int, size: int, seed: int) -> list[np.ndarray]:
    """Return noise, blobs, boards, stripes, nested squares and single colours."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((rows, columns))
    noise = rng.integers(0, 256, (rows, columns), dtype=np.uint8)
    blobs = cv2.GaussianBlur(noise, (0, 0), 1 + size / 3)
    nested = np.minimum(np.minimum(x, columns - 1 - x), np.minimum(y, rows - 1 - y))
    bits = (noise & 1, blobs > blobs.mean(), x // size + y // size, x // size, y // size, nested // size)
    return [
        noise,
        *((255 * (np.asarray(bit).astype(int) % 2)).astype(np.uint8) for bit in bits),
        0 * noise,
        0 * noise + 255,
    ]


@settings(max_examples=10, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.integers(1, 64), st.integers(1, 64), st.integers(1, 30), st.integers(0, 2**31))
def test_a_pattern_of_any_size_is_searched_without_complaint(rows: int, columns: int, size: int, seed: int) -> None:
    for image in patterns(rows, columns, size, seed):
        look(image, SEARCHERS[:1])


@pytest.mark.parametrize("shape", [(1, 1), (8, 8), (1, 640), (640, 1), (8, 300), (300, 8), (60, 80)], ids=str)
def test_images_as_narrow_as_one_pixel_are_searched(shape: tuple[int, int]) -> None:
    for image in patterns(*shape, size=3, seed=1):
        look(image, SEARCHERS[1:2])


def test_a_huge_image_is_searched() -> None:
    y, x = np.indices((3000, 4000), dtype=np.uint16)
    assert DETECTOR.detect((((x // 40 + y // 40) % 2) * 255).astype(np.uint8)) == []


def photograph(T_cam_marker: np.ndarray, surface: Flat | Cylinder, seed: int) -> np.ndarray:
    return render_marker(CAMERA, T_cam_marker, signature=CODES[seed % 20], side_m=0.1, surface=surface, seed=seed)


@settings(max_examples=5, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.integers(0, 2**31), st.floats(0.03, 1.0), st.sampled_from([Flat(), Cylinder(0.15), Cylinder(0.05, 0.7)]))
def test_markers_cut_turned_away_and_repeated_never_raise(seed: int, range_m: float, surface: Flat | Cylinder) -> None:
    rng = np.random.default_rng(seed)
    R = np.diag([1.0, -1.0, -1.0]) @ exp_so3(rng.normal(size=3) * rng.choice([0.2, 0.6, 1.2]))
    image = photograph(pose(R, [*rng.uniform(-0.2, 0.2, 2) * range_m, range_m]), surface, seed)
    look([image, np.roll(image, seed % 320, axis=1), image[::-1], 255 - image][seed % 4], SEARCHERS[seed % 3 :][:1])


FACING = pose(np.diag([1.0, -1.0, -1.0]) @ exp_so3([0.3, 0.2, 0.5]), [0.0, 0.0, 0.3])


def test_any_memory_layout_gives_the_same_detection() -> None:
    """Fortran order, a view with steps, a window of a larger image, read only, colour."""
    image = photograph(FACING, Flat(), 19)
    window, frozen = np.pad(image, 9)[9:-9, 9:-9], image.copy()
    frozen.flags.writeable = False
    every_other = np.repeat(np.repeat(image, 2, axis=0), 2, axis=1)[::2, ::2]
    colour = np.asfortranarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    (expected,) = DETECTOR.detect(image, CAMERA)
    for same in (np.asfortranarray(image), window, frozen, every_other, colour, colour[..., ::-1]):
        (seen,) = Detector().detect(same, CAMERA)
        np.testing.assert_array_equal(seen.corners_px, expected.corners_px)
        np.testing.assert_array_equal(seen.T_cam_marker, expected.T_cam_marker)


@pytest.mark.parametrize("side_m", [1e-300, 1e-9, 1e-3, 1e9, 1e300])
def test_results_are_finite_for_markers_of_any_side(side_m: float) -> None:
    for surface in (Flat(), Cylinder(1.5 * side_m)):
        assert_finite(Detector(side_m=side_m, surface=surface).detect(photograph(FACING, Flat(), 3), CAMERA))


@pytest.mark.parametrize(
    ("matrix", "distortion"),
    [
        (k(0, 0, 30.0), ()),
        (k(1, 1, 1e6), ()),
        (k(0, 2, -5000.0), ()),
        (k(1, 2, 1e8), ()),
        *((K, d) for d in ([-10, 0, 0, 0, 0], [1e3, 0, 0, 0, 0], [0, 0, -1e3, 1e3, 0], [0, 0, 0, 0, 1e6], [1e300] * 5)),
    ],
    ids=str,
)
def test_results_are_finite_through_any_camera(matrix: np.ndarray, distortion: list[float]) -> None:
    odd = Camera(matrix, distortion, width=320, height=240)
    for surface in (Flat(), Cylinder(0.15)):
        tracker = Tracker(Detector(surface=surface))
        for _ in range(2):
            assert_finite(tracker.detect(photograph(FACING, Flat(), 3), odd))
