"""Frames: whether squares are darker just inside their edges than outside, as a marker's black border is.

Compiled, and looked at no further than a square can still be one: most are none, and there are thousands.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from astratag.camera import pixel
from astratag.compiled import CUBE, GRAY, INT, REAL, VECTOR, array, compiled
from astratag.geometry import TEMPLATE_UNITS
from astratag.sampling import bilinear

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

LEAST_STEP_GREY = 4.0
"""How much brighter the surroundings of a square must be than its border, on average."""
ALONG = 5
"""Points along each side."""


def _frame_points() -> Array:
    """Return points outside and inside each side of the template's square (2 x 4 x 5, 2)."""
    along = np.linspace(0.1, 0.9, ALONG)
    across = np.array([-0.06, 0.035])[:, None] * np.ones(ALONG)
    top = np.stack([np.broadcast_to(along, across.shape), across], axis=2)
    sides = [top, top[..., ::-1] * (-1, 1) + (1, 0), top * (1, -1) + (0, 1), top[..., ::-1]]
    return np.stack(sides, axis=1).reshape(-1, 2) * TEMPLATE_UNITS


FRAME = _frame_points()
"""Template points (40, 2) outside each side of a square, side by side, and then inside each."""


@compiled(GRAY, CUBE, INT)
def darker_inside(gray: Image, at_px: Array, least: int) -> NDArray[np.bool_]:
    """Return which squares are darker inside than outside on so many sides, where ``FRAME`` lies (Q, F, 2) in them."""
    darker = np.empty(len(at_px), dtype=np.bool_)
    for q in range(len(at_px)):
        sides = 0
        for side in range(4):
            if sides + 4 - side < least:
                break
            step = 0.0
            for i in range(side * ALONG, (side + 1) * ALONG):
                outside, inside = at_px[q, i], at_px[q, i + 4 * ALONG]
                step += bilinear(gray, outside[0], outside[1]) - bilinear(gray, inside[0], inside[1])
            sides += step >= LEAST_STEP_GREY * ALONG
        darker[q] = sides >= least
    return darker


@compiled(GRAY, CUBE, array(REAL, 4), CUBE, VECTOR, REAL, INT)
def bent_darker_inside(
    gray: Image, frame: Array, rotation: Array, translation: Array, lens: Array, nearest: float, least: int
) -> NDArray[np.bool_]:
    """Return which bent squares (Q, M) are, seen at rotations (Q, M, 3, 3) and translations (Q, M, 3).

    ``frame`` (M, F, 3) is where ``FRAME`` lies on their cylinders; ``nearest`` is the least depth a point can have.
    """
    places, models = len(translation), len(frame)
    darker = np.empty((places, models), dtype=np.bool_)
    for q in range(places):
        for m in range(models):
            R, t, sides = rotation[q, m], translation[q, m], 0
            for side in range(4):
                if sides + 4 - side < least:
                    break
                step = 0.0
                for k in range(2 * ALONG):
                    inside = k // ALONG
                    X = frame[m, (4 * inside + side) * ALONG + k - inside * ALONG]
                    x = R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2] + t[0]
                    y = R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2] + t[1]
                    z = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2] + t[2]
                    u, v = pixel(x, y, max(z, nearest), lens)
                    step += (1 - 2 * inside) * bilinear(gray, u, v)
                sides += step >= LEAST_STEP_GREY * ALONG
            darker[q, m] = sides >= least
    return darker
