"""Planes seen in the frames of a recording, as means over the cells of the image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from rangeseg_ros.core.arrays import Floats, Indices, Labels, Mask
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.significance import SAMPLES

# Cells across the image: 8 pixels of a VGA image, a fraction of the length of any distortion.
_ACROSS = 80
# Pixels from another region up to which a pixel may be its neighbour's.
_RIM = 2
# Standard deviations beyond which a pixel is not the plane's.
_OUTLIER = 5.0


class Sightings(NamedTuple):
    """Planes seen in frames of one size, P of them, of N cells together.

    Each plane has the number of its `frame` (P,), of `frames` with those that show no plane, and
    the cells from its `start` (P + 1,) on: which `cell` of the image (N,), row by row, its mean
    inverse depth 1/z (N,), 1/m, and its mean ray (N, 3), scaled to z = 1.
    """

    frame: Indices
    start: Indices
    cell: Indices
    inverse: Floats
    ray: Floats
    frames: int

    def plane(self) -> Indices:
        """Plane (N,) that each cell belongs to."""
        return np.repeat(np.arange(len(self.frame)), np.diff(self.start))

    def rays(self) -> sparse.csr_array:
        """Matrix (N, 3 P) from the planes' theta to the inverse depths of their cells."""
        columns = 3 * self.plane()[:, None] + np.arange(3)
        pointers = np.arange(0, 3 * len(self.cell) + 1, 3)
        shape = len(self.cell), 3 * len(self.frame)
        return sparse.csr_array((self.ray.ravel(), columns.ravel(), pointers), shape)

    def of_planes(self, chosen: Mask) -> Sightings:
        """Those of the planes that are chosen, (P,)."""
        cells = chosen[self.plane()]
        start = np.concatenate([[0], np.cumsum(np.diff(self.start)[chosen])])
        parts = self.cell[cells], self.inverse[cells], self.ray[cells]
        return Sightings(self.frame[chosen], start, *parts, self.frames)


def cell_size(shape: tuple[int, int]) -> int:
    """Rows and columns of a cell, pixels."""
    return max(round(shape[1] / _ACROSS), 2)


def cell_grid(shape: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of cells in an image (H, W)."""
    size = cell_size(shape)
    return -(-shape[0] // size), -(-shape[1] // size)


def find_sightings(labels: Labels, image: RangeImage) -> Sightings:
    """Planes of one frame with these labels (H, W), 0 for no plane.

    An inverse range along a unit ray is taken as the inverse depth it is.
    """
    size, (rows, columns) = cell_size(labels.shape), cell_grid(labels.shape)
    height, width = labels.shape
    cells = np.arange(height)[:, None] // size * columns + np.arange(width) // size
    kernel = np.ones((2 * _RIM + 1, 2 * _RIM + 1), np.uint8)
    inner = (labels > 0) & image.valid & (image.depth_over_range > 0)
    inner &= cv2.erode(labels, kernel) == cv2.dilate(labels, kernel)
    along = np.where(inner, image.depth_over_range, 1).astype(np.float64)
    inverse, rays = image.inverse / along, image.rays / along[..., None]
    kept, means = [np.zeros(0, np.intp)], [np.zeros((0, 4))]
    for label in range(1, int(labels.max(initial=0)) + 1):
        mask = inner & (labels == label)
        if np.count_nonzero(mask) < SAMPLES * size * size:
            continue
        ray, y = rays[mask], inverse[mask]
        error = np.abs(y - ray @ np.linalg.lstsq(ray.T @ ray, ray.T @ y, rcond=None)[0])
        explained = error <= _OUTLIER * 1.4826 * np.median(error)
        own = cells[mask][explained]
        count = np.bincount(own, minlength=rows * columns)
        # Where half of a cell is the plane's, its mean stands for the cell.
        some = np.flatnonzero(2 * count >= size * size)
        if len(some) >= SAMPLES:
            values = (part[explained] for part in (y, *ray.T))
            sums = [np.bincount(own, part, len(count))[some] for part in values]
            kept.append(some)
            means.append(np.stack(sums, axis=1) / count[some, None])
    start = np.cumsum([len(part) for part in kept])
    found = np.concatenate(means)
    planes = np.zeros(len(start) - 1, np.intp)
    return Sightings(planes, start, np.concatenate(kept), found[:, 0], found[:, 1:], 1)


def concatenate(frames: Sequence[Sightings]) -> Sightings:
    """Sightings of several frames, numbered one after the other."""
    frame, start, cell, inverse, ray, count = zip(*frames, strict=True)
    first = np.cumsum([0, *count])
    cells = np.cumsum(np.concatenate([[0], *map(np.diff, start)]))
    frame = np.concatenate(frame) + np.repeat(first[:-1], [len(part) for part in frame])
    parts: list[NDArray[Any]] = [np.concatenate(part) for part in (cell, inverse, ray)]
    return Sightings(frame, cells.astype(np.intp), parts[0], parts[1], parts[2], int(first[-1]))
