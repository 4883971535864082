"""Square blocks of pixels: what tells the noise, and what surfaces are grown from."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Singles
from rangeseg_ros.core.sensing.moments import (
    CHI2,
    COUNT,
    NO_PIXEL,
    RATIO,
    SIZE,
    SLOPE,
    plane_of,
    plus_pixel,
    ray_of,
    sums_of,
)
from rangeseg_ros.core.sensing.range_image import RangeImage

NODE = 2
"""Rows and columns of the smallest block that holds a plane."""
BLOCK = 4
"""Rows and columns of a block: the least that tells the noise from a plane through it, with 13
degrees of freedom; it finds faces 10 pixels wide."""


class Blocks(NamedTuple):
    """The blocks (rows, columns) of an image and the planes through each, in 1/m^2.

    `moments` (..., 13) of the measured pixels have unit weights. `squared` is the mean square of
    the inverse range; `slope` is the square of its change from pixel to pixel on the plane, less
    what noise adds to it; `residual` is the sum of the squared residuals.
    """

    moments: Floats
    squared: Floats
    slope: Floats
    residual: Floats

    @classmethod
    def of(cls, image: RangeImage, size: int = BLOCK) -> Blocks:
        """Blocks of `size` pixels."""
        height, width = image.shape
        blocks = cls._empty(-(-height // size), -(-width // size))
        whole = 0, 0, *blocks.squared.shape
        _sum_pixels(image.inverse, image.rays, image.pinhole, size, whole, blocks)
        return blocks

    def updated(self, before: RangeImage, image: RangeImage, size: int = BLOCK) -> Blocks:
        """Update these blocks in place: `image` differs from `before` in a few pixels."""
        _update(before.inverse, image.inverse, image.rays, image.pinhole, size, self)
        return self

    def merged(self, rays: Singles, size: int) -> Blocks:
        """Every 2 x 2 of them as one: blocks of `size` pixels of these rays (H, W, 3)."""
        rows, columns = self.squared.shape
        blocks = self._empty((rows + 1) // 2, (columns + 1) // 2)
        blocks.moments[:] = sum_of_four(self.moments)
        _fit_planes(rays, size, (0, 0, *blocks.squared.shape), blocks)
        return blocks

    @classmethod
    def _empty(cls, rows: int, columns: int) -> Blocks:
        moments = np.empty((rows, columns, SIZE))
        return cls(moments, *(np.empty((rows, columns)) for _ in range(3)))


def sum_of_four(values: NDArray[Any]) -> Floats:
    """Sums over 2 x 2 of values (rows, columns, ...), of fewer at the border."""
    rows, columns, *rest = values.shape
    result = np.zeros(((rows + 1) // 2, (columns + 1) // 2, *rest))
    for i, j in (0, 0), (0, 1), (1, 0), (1, 1):
        part = values[i::2, j::2]
        result[: len(part), : part.shape[1]] += part
    return result


def for_pixels(values: NDArray, shape: tuple[int, int]) -> NDArray:
    """Values of the blocks, or one for all, for the pixels (H, W) of each."""
    blocks = np.broadcast_to(values, [-(-length // BLOCK) for length in shape])
    return blocks.repeat(BLOCK, axis=1).repeat(BLOCK, axis=0)[: shape[0], : shape[1]]


@njit(cache=True, nogil=True)
def _sum_pixels(
    inverse: Singles,
    rays: Singles,
    pinhole: bool,
    size: int,
    part: tuple[int, int, int, int],
    blocks: Blocks,
) -> None:
    """Fill in blocks of pixels, from a first row and column to those after the last."""
    height, width = inverse.shape
    moments, (top, begin, bottom, end) = blocks.moments, part
    for bi in range(top, bottom):
        for bj in range(begin, end):
            sums, count = NO_PIXEL, 0
            for i in range(bi * size, min((bi + 1) * size, height)):
                for j in range(bj * size, min((bj + 1) * size, width)):
                    if inverse[i, j] > 0:
                        # Not in float32, which 1.0 times a ray is where nothing is compiled.
                        x, y, z = ray_of(rays, pinhole, i, j)
                        x, y, z = np.float64(x), np.float64(y), np.float64(z)
                        sums = plus_pixel(sums, x, y, z, np.float64(inverse[i, j]), 1.0)
                        count += 1
            for k, value in enumerate(sums):
                moments[bi, bj, k] = value
            moments[bi, bj, COUNT], moments[bi, bj, RATIO], moments[bi, bj, SLOPE] = count, 0, 0
    _fit_planes(rays, size, part, blocks)


@njit(cache=True, nogil=True, error_model='numpy')
def _fit_planes(rays: Singles, size: int, part: tuple[int, int, int, int], blocks: Blocks) -> None:
    """Fill in the planes of blocks whose moments are known."""
    columns, (top, begin, bottom, end) = blocks.squared.shape[1], part
    m = blocks.moments.reshape(-1, SIZE)
    for bi in range(top, bottom):
        for bj in range(begin, end):
            k = bi * columns + bj
            x, y, z, left = plane_of(sums_of(m, k))
            count = m[k, COUNT]
            blocks.squared[bi, bj] = m[k, CHI2] / max(count, 1.0)
            blocks.residual[bi, bj] = left
            slope = 0.0
            if count > 3:
                slope += _change((x, y, z), rays, (bi * size, bj * size), size, (0, 1)) ** 2
                slope += _change((x, y, z), rays, (bi * size, bj * size), size, (1, 0)) ** 2
            # Less the variance of the slopes by noise.
            noise = left / max(count - 3, 1.0) * 2 * 12 / (size * size - 1) / max(count, 1.0)
            blocks.slope[bi, bj] = max(slope - noise, 0.0)


@njit(cache=True, nogil=True)
def _update(
    before: Singles, inverse: Singles, rays: Singles, pinhole: bool, size: int, blocks: Blocks
) -> None:
    """Fill in blocks with pixels that differ from those `before`."""
    height, width = inverse.shape
    for bi in range(len(blocks.squared)):
        for bj in range(blocks.squared.shape[1]):
            unchanged = True
            for i in range(bi * size, min((bi + 1) * size, height)):
                for j in range(bj * size, min((bj + 1) * size, width)):
                    unchanged &= inverse[i, j] == before[i, j]
            if not unchanged:
                _sum_pixels(inverse, rays, pinhole, size, (bi, bj, bi + 1, bj + 1), blocks)


@njit(cache=True, inline='always')
def _change(
    theta: tuple[float, float, float],
    rays: Singles,
    corner: tuple[int, int],
    size: int,
    way: tuple[int, int],
) -> float:
    """Change of the inverse range from pixel to pixel on the plane of a block.

    Between the two rays of a row (`way` 0, 1) or column (1, 0) that are farthest apart, else 0.
    """
    (top, left), (di, dj) = corner, way
    farthest, change = 0, 0.0
    for line in range(size):
        i, j, first, last = top + dj * line, left + di * line, 0, size - 1
        while first < last and not _known(rays, i + di * first, j + dj * first):
            first += 1
        while first < last and not _known(rays, i + di * last, j + dj * last):
            last -= 1
        if last - first > farthest:
            farthest, change = last - first, 0.0
            begin, end = (i + di * first, j + dj * first), (i + di * last, j + dj * last)
            for k in range(3):
                change += theta[k] * (rays[end[0], end[1], k] - rays[begin[0], begin[1], k])
            change /= farthest
        if farthest == size - 1:
            break
    return change


@njit(cache=True, inline='always')
def _known(rays: Singles, i: int, j: int) -> Any:
    """Whether there is a pixel and it has a ray: a cloud has none where nothing was measured."""
    if i >= rays.shape[0] or j >= rays.shape[1]:
        return False
    return (rays[i, j, 0] != 0) | (rays[i, j, 1] != 0) | (rays[i, j, 2] != 0)
