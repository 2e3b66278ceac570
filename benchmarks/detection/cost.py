"""CPU time a frame of every detector on the same scenes.

Each reads some pictures in a row, as it does in a process of its own, then the next has its turn at the same ones: so
that a busy machine is unkind to all alike.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from astratag.transforms import perturb
from benchmarks.detection.peers import ENTRANTS, TRACKED, Entrant, Reader, texture
from benchmarks.detection.recall import timed
from benchmarks.detection.scenes import Scene, draw

SCENES = {
    "1280x720": Scene(1280, 720, 998.0, 150.0),
    "640x480": Scene(640, 480, 500.0, 100.0),
    "320x240": Scene(320, 240, 250.0, 60.0),
}
STEP = np.array([5e-4, -3e-4, 1e-3, 4e-3, -3e-3, 5e-3])
"""How the marker moves from one frame to the next: metres and radians, right perturbation."""
TURN = 10
"""Pictures that each reads in a row."""
FIRST_SEED = 7000


def measure_cost(images: int, entrants: tuple[Entrant, ...] = (*ENTRANTS, TRACKED)) -> list[dict]:
    """Return a row for each image size and entrant: median CPU milliseconds, and how many times AstraTag's search."""
    cv2.setNumThreads(1)
    markers = {entrant.marker for entrant in entrants}
    rows = []
    for name, scene in SCENES.items():
        first = draw(scene, FIRST_SEED)
        readers: dict[str, Reader] = {entrant.name: entrant.start(first.surface) for entrant in entrants}
        spent: dict[str, list[float]] = {entrant.name: [] for entrant in entrants}
        found = dict.fromkeys(spent, 0)
        frames = range(images + 1)  # the first warms caches up, and finds the marker for the tracker
        for turn in (frames[start : start + TURN] for start in range(0, len(frames), TURN)):
            moved = [replace(first, T_cam_print=perturb(first.T_cam_print, STEP * frame)) for frame in turn]
            pictures = {marker: [one.photograph(texture(marker, 0, "equal")) for one in moved] for marker in markers}
            for entrant in entrants:
                read = readers[entrant.name]
                for frame, picture, one in zip(turn, pictures[entrant.marker], moved, strict=True):
                    seen, cpu_ms = timed(read, picture, one)
                    if frame:
                        spent[entrant.name].append(cpu_ms)
                        found[entrant.name] += bool(seen)
        of_astratag = np.median(spent[entrants[0].name])
        for entrant in entrants:
            cpu_ms = float(np.median(spent[entrant.name]))
            rows.append(
                {
                    "image": name,
                    "entrant": entrant.name,
                    "frames": images,
                    "found": found[entrant.name],
                    "cpu_ms": cpu_ms,
                    "of_astratag": float(cpu_ms / of_astratag),
                }
            )
    return rows
