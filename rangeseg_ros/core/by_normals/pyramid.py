"""A pyramid of grids: each level joins the sites of 2 x 2 of the level below.

A cell of 2 x 2 sites that its edges connect is one site of the next level. Of a cell that a jump
edge cuts, the larger part is; the rest is left out from there on. So a labelling of any level is a
labelling of pixels that is constant on the sites, and its energy is the same at both: data costs
add up, and so do the edges between two sites.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.graphcut.energy import link_costs
from rangeseg_ros.core.sensing.grid import Grid


class Pyramid(NamedTuple):
    """Grids of falling resolution; level 0 is that of the pixels.

    Attributes
    ----------
    links : list of (2, h, w) float32
        Cost of unlike labels across the edges of each site to the right and down.
    members : list of (h, w) bool
        Of each level but the last: sites that are part of one of the next level.
    top : (H, W) uint8
        Highest level of which each pixel is part.
    """

    links: list[NDArray[np.float32]]
    members: list[NDArray[np.bool_]]
    top: NDArray[np.uint8]

    @classmethod
    def of(cls, grid: Grid, smoothness: float, levels: int) -> Pyramid:
        """Join the pixels of a grid so many times."""
        shape = len(grid.right), grid.below.shape[1]
        links = [link_costs(grid, smoothness).reshape(2, *shape)]
        members: list[NDArray[np.bool_]] = []
        top, pixels = np.zeros(shape, np.uint8), np.ones(shape, np.int32)
        for level in range(levels):
            member = _larger_parts(links[-1], pixels)
            linked, pixels = _joined(links[-1], pixels, member)
            _rise(top, member, level)
            links.append(linked)
            members.append(member)
        return cls(links, members, top)


@njit(cache=True, nogil=True)
def _larger_parts(links: NDArray[np.float32], pixels: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Sites (h, w) in the largest connected part, in pixels (h, w), of their cell."""
    height, width = pixels.shape
    member = np.zeros((height, width), np.bool_)
    part, area = np.empty(4, np.int32), np.empty(4, np.int32)
    for i in range(0, height, 2):
        for j in range(0, width, 2):
            across, down = j + 1 < width, i + 1 < height
            part[:], area[:] = 0, 0
            # Sites 0 and 1 above 2 and 3, each in the part of the lowest that it is linked to.
            part[1] = 0 if across and links[0, i, j] > 0 else 1
            part[2] = 0 if down and links[1, i, j] > 0 else 2
            part[3] = part[1] if across and down and links[1, i, j + 1] > 0 else 3
            if across and down and links[0, i + 1, j] > 0:
                joined, gone = min(part[2], part[3]), max(part[2], part[3])
                for k in range(4):
                    if part[k] == gone:
                        part[k] = joined
            for k in range(4):
                if i + k // 2 < height and j + k % 2 < width:
                    area[part[k]] += pixels[i + k // 2, j + k % 2]
            largest = area.argmax()
            for k in range(4):
                if i + k // 2 < height and j + k % 2 < width:
                    member[i + k // 2, j + k % 2] = part[k] == largest
    return member


@njit(cache=True, nogil=True)
def _joined(
    links: NDArray[np.float32], pixels: NDArray[np.int32], member: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Links (2, h, w) and pixels (h, w) of the next level."""
    height, width = pixels.shape
    shape = (height + 1) // 2, (width + 1) // 2
    across, down = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    total = np.zeros(shape, np.int32)
    for i in range(height):
        for j in range(width):
            if not member[i, j]:
                continue
            total[i // 2, j // 2] += pixels[i, j]
            if j % 2 and j + 1 < width and member[i, j + 1]:
                across[i // 2, j // 2] += links[0, i, j]
            if i % 2 and i + 1 < height and member[i + 1, j]:
                down[i // 2, j // 2] += links[1, i, j]
    return np.stack((across, down)), total


@njit(cache=True, nogil=True)
def _rise(top: NDArray[np.uint8], member: NDArray[np.bool_], level: int) -> None:
    """Count the next level to `top` where sites of this one are members."""
    for i in range(len(top)):
        for j in range(top.shape[1]):
            if top[i, j] == level and member[i >> level, j >> level]:
                top[i, j] = level + 1
