"""Images with fewer measurements than pixels, because somebody enlarged them: found and undone."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Indices, Singles
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.significance import quantile

SIGNIFICANT = 5.0
"""Standard errors beyond which a statistic is no chance, in any of all images."""
# Rows or columns, and those whose spectrum is looked at, that stand for an image.
_LINES, _FEW = 60, 24
_LARGEST = 16  # enlargement that is looked for
_PERIODS = np.arange(2, _LARGEST + 1)
# Steps from the pixel behind the centre of a cell to the two next to it, and to the two after.
_SIDES = (-1, 0), (-2, 1)


class Cells(NamedTuple):
    """Squares of `factor` x `factor` pixels that hold one measurement each.

    `rows` and `columns` are how many of the first one are cropped. Between the centres of `linear`
    ones the depth is linear, else all pixels of a cell are alike.
    """

    factor: int
    rows: int
    columns: int
    linear: bool = False

    def reduced(self, image: RangeImage) -> RangeImage:
        """The image with a pixel for each cell, the cropped ones included."""
        rows, columns = map(self._middles, image.shape, (self.rows, self.columns))
        picked = np.ix_(rows, columns)
        inverse = image.inverse[picked]
        if self.linear and self.factor % 2 == 0:
            depth = _depth(image.inverse)
            found = _at_centres(_at_centres(depth, columns).T, rows).T
            # Cells that were not measured are 0 but for rounding; no sensor sees a hundred times
            # nearer than it mostly does.
            least = 0.01 * np.median(depth[depth > 0]) if depth.any() else np.inf
            inverse = np.where(found > least, 1 / found.clip(1e-9), 0)
            inverse = inverse.astype(np.float32)
            inverse.flags.writeable = False
        camera = camera_of_cells(self, image.camera) if image.camera else None
        rays = image.rays[picked] if camera is None else camera.rays
        body = None if image.body is None else image.body[picked]
        return replace(image, rays=rays, inverse=inverse, camera=camera, body=body)

    def _middles(self, size: int, cropped: int) -> Indices:
        """Pixels, along `size` of them, at the centres of cells or behind these."""
        k = self.factor
        return np.clip(k // 2 - cropped + k * np.arange(-(-(size + cropped) // k)), 0, size - 1)

    def enlarged(self, array: NDArray, shape: tuple[int, int]) -> NDArray:
        """Values (h, w, ...) of the cells for all pixels of an image (H, W)."""
        pixels = array.repeat(self.factor, axis=1).repeat(self.factor, axis=0)
        return pixels[self.rows : self.rows + shape[0], self.columns : self.columns + shape[1]]


def _depth(inverse: Singles) -> Floats:
    """Depth, 0 where it was not measured."""
    return np.divide(1.0, inverse, out=np.zeros(inverse.shape), where=inverse > 0)


def _at_centres(depth: Floats, columns: Indices) -> Floats:
    """Values (N, n) at the centres of cells between columns (n,) and those before, of (N, W).

    From the two pixels on each side, between which and the centre the depth is linear.
    """
    last = depth.shape[1] - 1
    near, far = ([depth[:, (columns + s).clip(0, last)] for s in side] for side in _SIDES)
    known = [(a > 0) & (b > 0) for a, b in zip(near, far, strict=True)]
    sides = [(1.5 * a - 0.5 * b) * k for a, b, k in zip(near, far, known, strict=True)]
    return np.asarray(sum(sides) / np.maximum(np.sum(known, axis=0), 1))


# Weak keys: entries live as long as their cameras, as rays of 12 megapixels take 150 MB.
_cameras: WeakKeyDictionary[Camera, dict[Cells, Camera]] = WeakKeyDictionary()


def camera_of_cells(cells: Cells, camera: Camera) -> Camera:
    """The camera that has a pixel for each cell, at its centre; kept, as its rays are."""
    known = _cameras.setdefault(camera, {})
    if cells not in known:
        known[cells] = _camera_of_cells(cells, camera)
    return known[cells]


def _camera_of_cells(cells: Cells, camera: Camera) -> Camera:
    k, middle = cells.factor, (cells.factor - 1) / 2
    return replace(
        camera,
        width=-(-(camera.width + cells.columns) // k),
        height=-(-(camera.height + cells.rows) // k),
        fx=camera.fx / k,
        fy=camera.fy / k,
        cx=(camera.cx + cells.columns - middle) / k,
        cy=(camera.cy + cells.rows - middle) / k,
        skew=camera.skew / k,
    )


def enlargement(image: RangeImage) -> Cells | None:
    """Cells of one measurement each, where an image was enlarged; None where it was not."""
    return replication(image) or interpolation(image)


def replication(image: RangeImage) -> Cells | None:
    """Cells of equal values, as nearest neighbours enlarge an image; None where there are none.

    Columns and rows at which neighbours differ are multiples of the factor apart. At least half of
    the borders must show it: a few edges of an exact scene may lie at multiples by chance.
    """
    factor, columns = _period(image.inverse)
    if not factor:
        return None
    other, rows = _period(image.inverse.T)
    return Cells(factor, rows, columns) if factor == other else None


def _period(lines: Singles) -> tuple[int, int]:
    """Distance of the columns at which values change, and what the first one lacks; 0 for none."""
    lines = np.ascontiguousarray(lines[:: max(len(lines) // _LINES, 1)])
    before, after = lines[:, :-1], lines[:, 1:]
    changes = np.flatnonzero(((before != after) & (before > 0) & (after > 0)).any(axis=0)) + 1
    period = int(np.gcd.reduce(np.diff(changes)))
    few = 2 * len(changes) * period < lines.shape[1]
    if few or not 2 <= period <= _LARGEST:
        return 0, 0
    return period, int(-changes[0] % period)


def interpolation(image: RangeImage) -> Cells | None:
    """Cells between whose centres the depth is linear; None where it is not.

    Second differences vanish but beside the centres, at every k-th pixel: their mean size per
    column has a line in its spectrum (Fisher 1929), for k = 2 that of third differences.
    """
    amplitude = np.full(len(_PERIODS), np.inf)
    for lines in (image.inverse, image.inverse.T):
        some = np.ascontiguousarray(lines[:: max(len(lines) // _FEW, 1)])
        with np.errstate(divide='ignore', invalid='ignore'):
            distance = 1 / some
            second = np.diff(distance, 2)
            third = np.diff(second)
        found = _spectrum(second, distance, slice(0, None))
        found[:1] = _spectrum(third, distance, slice(0, 1))
        amplitude = np.minimum(amplitude, found)
        # Of a period all divisors show.
        periods = _PERIODS[amplitude > SIGNIFICANT]
        if not len(periods):
            return None
    columns, rows = (
        _cropped(lines, int(periods[-1])) for lines in (image.inverse, image.inverse.T)
    )
    return Cells(int(periods[-1]), rows, columns, True)


def _cropped(lines: Singles, factor: int) -> int:
    """Pixels that the first cell lacks where lines (H, W) are linear between centres of cells."""
    depth = _depth(lines[:: max(len(lines) // _FEW, 1)])
    pixel, error = np.arange(depth.shape[1]), []
    for cropped in range(factor):
        columns = Cells(factor, 0, 0)._middles(depth.shape[1], cropped)
        centres = depth[:, columns] if factor % 2 else _at_centres(depth, columns)
        place = ((pixel + cropped - (factor - 1) / 2) / factor).clip(0, len(columns) - 1)
        before = np.minimum(place.astype(np.intp), len(columns) - 2)
        share = place - before
        between = centres[:, before] * (1 - share) + centres[:, before + 1] * share
        error.append(np.abs(between - depth)[depth > 0].sum())
    return int(np.argmin(error))


def _spectrum(differences: NDArray[Any], distance: NDArray[Any], periods: slice) -> Floats:
    """Amplitude of the size of differences along lines at each period, in standard errors."""
    size = np.abs(differences)
    known = np.isfinite(size)
    count = known.sum(axis=0)
    # Of other columns in each line. Of float32, and of sensors whose steps are wide, many are 0.
    some, far = (a.ravel()[:: _FEW | 1] for a in (size, distance[:, : size.shape[1]]))
    typical = some[(some > 1e-5 * far) & (some < np.inf)]
    waves = _waves(distance.shape[1])[periods, : len(count)]
    if not len(typical) or np.count_nonzero(count) < 2 * _LARGEST:
        return np.zeros(len(waves))
    # Edges of objects are no part of it.
    size = np.where(known, np.minimum(size, 2 * quantile(typical, 0.5)), 0)
    means = size.sum(axis=0, dtype=float) / np.maximum(count, 1)
    means = np.where(count > 0, means - means[count > 0].mean(), 0)
    # Not by BLAS, whose threads would take longer.
    return np.abs((waves * means).sum(axis=1)) / max((means * means).sum() ** 0.5, 1e-300)


@lru_cache(maxsize=4)
def _waves(width: int) -> NDArray[np.complex128]:
    """A wave (periods, W) of each period along a line of so many pixels."""
    return np.exp(2j * np.pi * np.arange(width) / _PERIODS[:, None])
