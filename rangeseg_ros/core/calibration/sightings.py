"""Planes seen in the frames of a recording, as means over the cells of the image."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

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

    Attributes
    ----------
    frame : (P,) int
        Number of the frame.
    start : (P + 1,) int
        Where the cells of each plane begin.
    cell : (N,) int
        Which cell of the image, row by row.
    inverse : (N,) float64
        Mean inverse depth 1/z, 1/m.
    ray : (N, 3) float64
        Mean ray, scaled to z = 1.
    frames : int
        Number of frames, with those that show no plane.
    """

    frame: NDArray[np.intp]
    start: NDArray[np.intp]
    cell: NDArray[np.intp]
    inverse: NDArray[np.float64]
    ray: NDArray[np.float64]
    frames: int

    def plane(self) -> NDArray[np.intp]:
        """Plane (N,) that each cell belongs to."""
        return np.repeat(np.arange(len(self.frame)), np.diff(self.start))

    def rays(self) -> sparse.csr_array:
        """Matrix (N, 3 P) from the planes' theta to the inverse depths of their cells."""
        columns = 3 * self.plane()[:, None] + np.arange(3)
        pointers = np.arange(0, 3 * len(self.cell) + 1, 3)
        shape = len(self.cell), 3 * len(self.frame)
        return sparse.csr_array((self.ray.ravel(), columns.ravel(), pointers), shape)

    def of_planes(self, chosen: NDArray[np.bool_]) -> Sightings:
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


def find_sightings(labels: NDArray[np.uint16], image: RangeImage) -> Sightings:
    """Planes of one frame.

    Parameters
    ----------
    labels : (H, W) uint16
        Regions, 0 for no plane.
    image : RangeImage
        (H, W); an inverse range along a unit ray is taken as the inverse depth it is.
    """
    size, (rows, columns) = cell_size(labels.shape), cell_grid(labels.shape)
    height, width = labels.shape
    cells = np.arange(height)[:, None] // size * columns + np.arange(width) // size
    found = []
    for mask, y, ray, _ in plane_pixels(labels, image, SAMPLES * size * size):
        own = cells[mask]
        count = np.bincount(own, minlength=rows * columns)
        # Where half of a cell is the plane's, its mean stands for the cell.
        kept = np.flatnonzero(2 * count >= size * size)
        if len(kept) < SAMPLES:
            continue
        sums = [np.bincount(own, part, len(count))[kept] for part in (y, *ray.T)]
        found.append((kept, np.stack(sums, axis=1) / count[kept, None]))
    means = np.concatenate([np.empty((0, 4)), *(part for _, part in found)])
    return Sightings(
        np.zeros(len(found), np.intp),
        np.concatenate([[0], np.cumsum([len(kept) for kept, _ in found])]).astype(np.intp),
        np.concatenate([np.empty(0, np.intp), *(kept for kept, _ in found)]),
        means[:, 0],
        means[:, 1:],
        1,
    )


class PlanePixels(NamedTuple):
    """Pixels of a plane without its rim and without outliers, n of them.

    Attributes
    ----------
    mask : (H, W) bool
    inverse, ray : (n,) and (n, 3) float64
        Inverse depth, 1/m, and ray at depth 1.
    residual : (n,) float64
        What the least-squares plane leaves of the inverse depth, 1/m.
    """

    mask: NDArray[np.bool_]
    inverse: NDArray[np.float64]
    ray: NDArray[np.float64]
    residual: NDArray[np.float64]


def plane_pixels(
    labels: NDArray[np.uint16], image: RangeImage, fewest: int
) -> Iterator[PlanePixels]:
    """Pixels of each plane that has so many."""
    kernel = np.ones((2 * _RIM + 1, 2 * _RIM + 1), np.uint8)
    inner = (labels > 0) & image.valid & (image.along > 0)
    inner &= cv2.erode(labels, kernel) == cv2.dilate(labels, kernel)
    along = np.where(inner, image.along, 1).astype(np.float64)
    inverse = image.inverse.astype(np.float64) / along
    rays = image.rays.astype(np.float64) / along[..., None]
    for label in range(1, int(labels.max(initial=0)) + 1):
        mask = inner & (labels == label)
        if np.count_nonzero(mask) < fewest:
            continue
        error = np.abs(_residual(rays[mask], inverse[mask]))
        mask[mask] = error <= _OUTLIER * 1.4826 * np.median(error)
        yield PlanePixels(mask, inverse[mask], rays[mask], _residual(rays[mask], inverse[mask]))


def _residual(rays: NDArray[np.float64], inverse: NDArray[np.float64]) -> NDArray[np.float64]:
    """What the least-squares plane theta . ray = inverse depth leaves (n,)."""
    theta, *_ = np.linalg.lstsq(rays.T @ rays, rays.T @ inverse, rcond=None)
    return np.asarray(inverse - rays @ theta)


def concatenate(frames: Sequence[Sightings]) -> Sightings:
    """Sightings of several frames, numbered one after the other."""
    first = np.cumsum([0, *(part.frames for part in frames)]).tolist()
    counts = np.concatenate([np.diff(part.start) for part in frames])
    return Sightings(
        np.concatenate([part.frame + at for part, at in zip(frames, first[:-1], strict=True)]),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.intp),
        np.concatenate([part.cell for part in frames]),
        np.concatenate([part.inverse for part in frames]),
        np.concatenate([part.ray for part in frames]),
        first[-1],
    )
