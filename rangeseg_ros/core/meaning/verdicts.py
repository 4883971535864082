"""What surfaces beside the ground are: level with it, an obstacle, a drop, or not known."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.meaning.beside import Sides
from rangeseg_ros.core.meaning.classes import DROP, GROUND, HIDDEN, OBSTACLE, UNKNOWN
from rangeseg_ros.core.significance import SAMPLES

BLUR = (5, 3)
"""Cells that the edge of a drop is blurred over: two rows on either side, as many as a Kinect's
noise is correlated over, and the next column."""


@njit(cache=True, nogil=True)
def parts_of(
    fallen: NDArray[np.bool_],
    risen: NDArray[np.bool_],
    steep: NDArray[np.bool_],
    ground: NDArray[np.bool_],
) -> NDArray[np.uint8]:
    """Parts of the cells that are not ground, (rows, columns), see `join_cells`."""
    rows, columns = ground.shape
    part = np.empty((rows, columns), np.uint8)
    for i in range(rows):
        for c in range(columns):
            remains = np.uint8(not (steep[i, c] | ground[i, c]))
            part[i, c] = (np.uint8(fallen[i, c]) + 2 * np.uint8(risen[i, c]) + 1) * remains
    return part


@njit(cache=True, nogil=True)
def level_with_ground(sides: Sides, least: float, drop: float) -> NDArray[np.bool_]:
    """Surfaces (N,) that differ from the ground by `least` or less, metres.

    Beyond an edge, where the noise would hide a drop, it is not known what is level.
    """
    level = np.zeros(len(sides.sizes), np.bool_)
    for k in range(len(level)):
        hidden = sides.beyond[k] and sides.noise[k] > drop - least
        level[k] = sides.sizes[k] >= SAMPLES and abs(sides.height[k]) <= least and not hidden
    return level


@njit(cache=True, nogil=True)
def set_apart(
    level: NDArray[np.bool_],
    surface: NDArray[np.int32],
    height: NDArray[np.float32],
    least: float,
    risen: NDArray[np.bool_],
    part: NDArray[np.uint8],
) -> bool:
    """Take what is as low as ground may be out of what has risen; whether there is any."""
    found = False
    for i in range(part.shape[0]):
        for c in range(part.shape[1]):
            if risen[i, c] and height[i, c] <= least and level[surface[i, c]]:
                risen[i, c] = False
                part[i, c] = 1
                found = True
    return found


@njit(cache=True, nogil=True)
def add_level(
    level: NDArray[np.bool_], surface: NDArray[np.int32], ground: NDArray[np.bool_]
) -> None:
    """Add the surfaces that are level to the ground."""
    for i in range(ground.shape[0]):
        for c in range(ground.shape[1]):
            ground[i, c] |= level[surface[i, c]]


@njit(cache=True, nogil=True)
def verdicts_of(
    sides: Sides, level: NDArray[np.bool_], surface: NDArray[np.int32], patch: float
) -> NDArray[np.int8]:
    """What the surfaces are, (N,), see `classes`.

    `patch` is the width of one of the distortion, cells.
    """
    verdict = np.empty(len(level), np.int8)
    for k in range(len(level)):
        # Little pieces among the ground are its noise.
        verdict[k] = UNKNOWN if sides.beyond[k] or k == 0 else GROUND
        if sides.sizes[k] >= SAMPLES:
            # A surface of far cells is as sure as each of them, as their errors are alike; beyond
            # an edge as all patches of the distortion along it together, as the ground before it
            # errs likewise.
            patches = max(sides.width[k] / patch, 1.0) if sides.beyond[k] else 1.0
            verdict[k] = OBSTACLE if sides.height[k] > 0 else DROP
            if abs(sides.height[k]) <= sides.noise[k] / np.sqrt(patches):
                verdict[k] = HIDDEN
        if level[k]:
            verdict[k] = GROUND
    _doubt_beside_drops(verdict, sides.sizes, surface)
    return verdict


@njit(cache=True, inline='always')
def _doubt_beside_drops(
    verdict: NDArray[np.int8], sizes: NDArray[np.int64], surface: NDArray[np.int32]
) -> None:
    """Little pieces beside a drop may be its own."""
    rows, columns = surface.shape
    high, wide = BLUR[0] // 2, BLUR[1] // 2
    little = (sizes < SAMPLES) & (verdict == GROUND)
    if not (verdict == DROP).any():
        return
    for i in range(rows):
        for c in range(columns):
            k = surface[i, c]
            if not little[k]:
                continue
            for m in range(max(i - high, 0), min(i + high + 1, rows)):
                for n in range(max(c - wide, 0), min(c + wide + 1, columns)):
                    if verdict[surface[m, n]] == DROP:
                        verdict[k] = HIDDEN
