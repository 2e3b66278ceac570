"""False accepts: pictures with no marker in them, until the detector's search has proposed enough candidates.

A candidate is a quad that AstraTag's search hands to the decoder; each is read at several layers, warps and turns.
Textures are photographs (any folder; markers that AstraTag finds in them are painted over) and, whatever else there
is, one made of noise at all scales and of shapes.  Each picture is a random piece of one: turned, seen at an angle,
enlarged, mirrored, inverted, its contrast changed, with noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray

from astratag import Detector, load_dictionary
from astratag.candidates import LEAST_RELIT_SIDE_PX, looks_large, points_in
from astratag.codes import acceptance_threshold, effective_cells
from astratag.edges import inverse_transfer
from astratag.relight import RELIT_SAMPLES, relit_cells
from astratag.search import BROAD, FAINT, NARROW, PLAIN, find_quads
from astratag.signature import BLUR_UNITS, EFFECTIVE_SHARE, LEAST_SEEN, SAMPLES, Codebook, cell_values, unit
from benchmarks.detection.peers import ENTRANTS, Entrant
from benchmarks.detection.recall import wilson
from benchmarks.detection.scenes import Scene, draw

Picture = NDArray[np.uint8]
FIRST_SEED = 9000
SIZE = (640, 480)
FRAMES_AT_MOST = 20_000
SUFFIXES = {".png", ".jpg", ".jpeg"}


def textures(folder: Path | None) -> dict[str, Picture]:
    """Return pictures by name: those of a folder, Matplotlib's sample photograph, and a made one."""
    sample = Path(matplotlib.get_data_path()) / "sample_data" / "grace_hopper.jpg"
    paths = [path for path in (sample, *sorted(folder.iterdir() if folder else ())) if path.suffix.lower() in SUFFIXES]
    pictures = {path.name: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths if path.exists()}
    read = {name: painted_over(picture) for name, picture in pictures.items() if picture is not None}
    return read | {"made": made_texture()}


def painted_over(picture: Picture) -> Picture:
    """Return a picture with the AstraTags found in it hidden by a grey patch twice their size."""
    picture = picture.copy()
    for seen in Detector().detect(picture):
        middle = seen.corners_px.mean(axis=0)
        cv2.fillConvexPoly(picture, np.round(middle + 2 * (seen.corners_px - middle)).astype(np.int32), 90)
    return picture


def made_texture(size: int = 1024) -> Picture:
    """Return noise with a 1/f spectrum under bright and dark shapes."""
    rng = np.random.default_rng(FIRST_SEED)
    scale = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :])
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) / np.maximum(scale, 1 / size))
    picture = cv2.normalize(noise, None, 20, 235, cv2.NORM_MINMAX).astype(np.uint8)
    for _ in range(400):
        box = (rng.uniform(0, size, 2).tolist(), rng.uniform(4, 60, 2).tolist(), float(rng.uniform(0, 180)))
        cv2.fillPoly(picture, [cv2.boxPoints(box).astype(np.int32)], int(rng.integers(256)))
    return picture


def pieces(sources: list[Picture]) -> Iterator[tuple[int, Picture]]:
    """Yield seeds and pictures without end: random pieces of the textures."""
    for seed in range(FIRST_SEED, FIRST_SEED + FRAMES_AT_MOST):
        rng = np.random.default_rng(seed)
        source = sources[rng.integers(len(sources))]
        extent = np.array(source.shape[::-1])
        angle, span = rng.uniform(0, 2 * np.pi), np.exp(rng.uniform(np.log(120), np.log(extent.min())))
        square = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]) * rng.choice([(1, 1), (-1, 1)])
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        corners = rng.uniform(0.2, 0.8, 2) * extent + span * (square + rng.uniform(-0.12, 0.12, (4, 2))) @ turn.T
        onto = (square * (1, 1) + 0.5) * SIZE
        H = cv2.getPerspectiveTransform(corners.astype(np.float32), onto.astype(np.float32))
        piece = cv2.warpPerspective(source, H, SIZE, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT).astype(float)
        piece = 255 * (piece / 255) ** np.exp(rng.uniform(-0.5, 0.5)) * rng.choice([-1, 1])
        piece = piece % 255.0 + rng.uniform(0, 4) * rng.standard_normal(piece.shape)
        yield seed, np.clip(np.round(piece), 0, 255).astype(np.uint8)


def measure_effective_cells(pictures: int, folder: Path | None) -> dict[str, float]:
    """Return what a cell of real texture is worth: ``effective_cells`` of all quads found, by how blurred the code is.

    The parents of ``EFFECTIVE_SHARE`` and ``BLURRED_CELLS``.  Of relit quads, the share that chance explains less often
    than once in a hundred, which should be below 0.01.
    """
    dictionary, light_of = load_dictionary(), inverse_transfer("srgb")
    codebook = Codebook(dictionary)
    cells, relit = [], []
    for _, picture in islice(pieces(list(textures(folder).values())), pictures):
        light = cv2.LUT(picture, light_of)
        quads = np.concatenate([find_quads(picture, how) for how in (PLAIN, NARROW, FAINT, BROAD)])
        if len(quads):
            cells.append(unit(cell_values(picture, points_in(quads, SAMPLES), light_of.astype(float))))
        large = quads[looks_large(quads) >= LEAST_RELIT_SIDE_PX]
        if len(large):
            readings = codebook.read_seen(*relit_cells(light, points_in(large, RELIT_SAMPLES)))
            relit += [reading for reading in readings if reading.cells >= LEAST_SEEN]
    templates = 4 * len(dictionary)
    found = {
        f"blur {width:g} units": effective_cells((np.concatenate(cells) @ codes.T).max(axis=1), templates)
        for width, codes in zip(BLUR_UNITS, codebook.unit_codes, strict=True)
    }
    above = [r.correlation > acceptance_threshold(templates, 1, 0.01, EFFECTIVE_SHARE * r.cells) for r in relit]
    return {"quads": float(sum(map(len, cells))), **found, "relit above 1 %": float(np.mean(above or 0.0))}


def measure_false_accepts(
    candidates: int, folder: Path | None, entrants: tuple[Entrant, ...] = ENTRANTS
) -> dict[str, object]:
    """Return what each detector reported over pictures without markers that gave at least so many candidates."""
    cv2.setNumThreads(1)
    sources = textures(folder)
    empty = draw(Scene(), 0)
    readers = {entrant.name: entrant.start(empty.surface) for entrant in entrants}
    reports = {name: 0 for name in readers}
    false_seeds: dict[str, list[int]] = {name: [] for name in readers}
    frames = scored = 0
    for seed, picture in pieces(list(sources.values())):
        frames, scored = frames + 1, scored + len(find_quads(picture))
        for name, read in readers.items():
            seen = read(picture, empty.camera)
            reports[name] += len(seen)
            false_seeds[name] += [seed] if seen else []
        if scored >= candidates:
            break
    return {
        "textures": sorted(sources),
        "first_seed": FIRST_SEED,
        "frames": frames,
        "candidates": scored,
        "counted": "quads that astratag.search.find_quads returned, each read at several layers, warps and turns",
        "entrants": [
            {
                "entrant": name,
                "reports": count,
                "seeds": false_seeds[name],
                "frame_rate_95": wilson(len(false_seeds[name]), frames),
            }
            for name, count in reports.items()
        ],
    }
