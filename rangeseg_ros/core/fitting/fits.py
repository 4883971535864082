"""Least-squares planes of regions, and how far they may be off."""

from __future__ import annotations

from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.borders import Borders, find_borders
from rangeseg_ros.core.fitting.cells import POINT, SCATTER, Cells
from rangeseg_ros.core.fitting.doubtful import sums_without_doubtful
from rangeseg_ros.core.fitting.first_planes import FirstPlanes
from rangeseg_ros.core.fitting.interior import interior
from rangeseg_ros.core.fitting.uncertainty import (
    Field,
    pairs,
    sandwiches,
    systematic_field,
    theta_covariances,
)
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.grid import weights
from rangeseg_ros.core.sensing.moments import COUNT, SIZE, cofactors, fit_all
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel

# Sine of the angle at which no surface is seen any more.
_GRAZING = 1e-3


class Fits(NamedTuple):
    """Planes theta . ray = inverse range of regions 0...M; zeros where there is none.

    Attributes
    ----------
    cells : Cells
        Sums over the pixels that were fitted, of the parts that the regions consist of.
    parts, start : (P,), (M + 2,) int
        Region k consists of the parts from start[k] to start[k + 1].
    pixels : (M + 1,) int
        Number of measured pixels.
    outliers : (M + 1,) int
        Number of those beyond four standard deviations of the sensor's errors.
    explained : (M + 1, 25) float64
        Sums, as of a cell, over the other pixels.
    theta : (M + 1, 3) float64
    inverse : (M + 1, 3, 3) float64
        Of the sums of w r r^T.
    covariance : (M + 1, 3, 3) float64
        Of theta.
    middle : (M + 1, 3, 3) float64
        What stands in it between inverse and inverse.
    sensor : SensorModel
    systematic : Field
        Its systematic errors.
    step : int
        Columns and rows of the image from one pixel that was looked at to the next.
    """

    cells: Cells
    parts: NDArray[np.intp]
    start: NDArray[np.intp]
    pixels: NDArray[np.intp]
    outliers: NDArray[np.intp]
    explained: NDArray[np.float64]
    theta: NDArray[np.float64]
    inverse: NDArray[np.float64]
    covariance: NDArray[np.float64]
    middle: NDArray[np.float64]
    sensor: SensorModel
    systematic: Field
    step: int = 1

    @classmethod
    def of(
        cls,
        labels: NDArray[np.uint16],
        image: RangeImage,
        sensor: SensorModel,
        blocks: Blocks | None = None,
        first: FirstPlanes | None = None,
        borders: Borders | None = None,
    ) -> Fits:
        """Fit a plane to every region.

        Weighted least squares in inverse range, where a plane is linear and the error of a
        camera lies. An organised cloud tells neither its sensor's centre nor the direction of
        its errors; there the plane is that of total least squares of the points. Either is
        fitted again without the pixels that the first fit leaves beyond four standard deviations
        of the sensor's errors, as borders of regions have them, and without the rim of the
        region, where pixels of its neighbours may pass for its own.

        Parameters
        ----------
        labels : (H, W) uint16
            0...M, 0 for no plane.
        image : RangeImage
            (H, W).
        sensor : SensorModel
            Errors of the image.
        blocks : Blocks, optional
            Of the image, where they are known.
        first : FirstPlanes, optional
            Of the labels, where they are known.
        borders : Borders, optional
            Of the labels, where they are known.
        """
        blocks = blocks or Blocks.of(image)
        first = first or FirstPlanes.of(labels, image, blocks, sensor)
        count = len(first.theta)
        borders = borders or find_borders(labels, weights(image), count)
        inner = interior(labels, first.filled)
        cells = Cells.empty(borders.box, borders.length)
        cells, pixels, outliers, explained = sums_without_doubtful(
            cells, labels, image, first.theta, sensor, blocks, inner
        )
        sums = cells.regions()
        theta, inverse = _solved(sums, image.camera is not None)
        covariance, middle = theta_covariances(cells, theta, inverse, sensor)
        systematic = systematic_field(sensor)
        parts, start = np.arange(count), np.arange(count + 1)
        counts = pixels, outliers, explained
        planes = theta, inverse, covariance, middle
        return cls(cells, parts, start, *counts, *planes, sensor, systematic)

    def united(self, group: NDArray[np.integer], central: bool) -> Fits:
        """Planes of regions united to groups.

        Parameters
        ----------
        group : (M + 1,) int
            Group of each region, 0...N; 0 for none.
        central : bool
            Whether the image was seen from one centre, as by a camera.
        """
        count = int(group.max(initial=0)) + 1
        sums = _total(self.cells.regions(), group, count)
        theta, inverse = _solved(sums, central)
        middle = _total(self.middle, group, count)
        for k in np.flatnonzero(np.bincount(group)[1:] > 1) + 1:
            for a, b in combinations(np.flatnonzero(group == k).tolist(), 2):
                # The errors of two regions agree where they are smooth.
                common = pairs(self.cells, a, self.theta[a], b, self.theta[b], self.systematic)
                middle[k] += common + common.T
        return self._replace(
            parts=np.argsort(group, kind='stable'),
            start=np.concatenate([[0], np.cumsum(np.bincount(group, minlength=count))]),
            pixels=_total(self.pixels, group, count),
            outliers=_total(self.outliers, group, count),
            explained=_total(self.explained, group, count),
            theta=theta,
            inverse=inverse,
            covariance=sandwiches(inverse, middle),
            middle=middle,
        )

    def magnified(self, step: int, pixels: NDArray[np.intp]) -> Fits:
        """The same planes, of regions of an image of which every `step`-th pixel was looked at.

        Parameters
        ----------
        step : int
        pixels : (M + 1,) int
            Number of measured pixels of each region.
        """
        return self._replace(
            pixels=pixels,
            outliers=self.outliers * pixels // np.maximum(self.pixels, 1),
            step=step,
        )

    def boxes(self) -> NDArray[np.intp]:
        """Bounding boxes (M + 1, 4), see `Cells.box`."""
        box, first = self.step * self.cells.box[self.parts], self.start[:-1]
        return np.concatenate(
            [np.minimum.reduceat(box[:, :2], first), np.maximum.reduceat(box[:, 2:], first)],
            axis=1,
        )


def _total(values: NDArray[Any], group: NDArray[np.integer], count: int) -> NDArray[Any]:
    """Sums over groups; zeros for group 0."""
    result = np.zeros((count, *values.shape[1:]), values.dtype)
    np.add.at(result, group, values)
    result[0] = 0
    return result


def _solved(
    sums: NDArray[np.float64], central: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Planes (M + 1, 3) of sums (M + 1, 25), and the inverses of their normal matrices."""
    theta = _theta(sums)
    if not central:
        theta = _total_least_squares(sums, theta)
    return theta, _inverses(sums, theta)


@njit(cache=True)
def _inverses(sums: NDArray[np.float64], theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverses (M + 1, 3, 3) of the normal matrices where there is a plane; zeros elsewhere."""
    inverse = np.zeros((len(theta), 3, 3))
    for k in range(len(theta)):
        if theta[k].any():
            a, b, c, d, e, f = sums[k, :6]
            aa, bb, cc, dd, ee, ff, determinant = cofactors(a, b, c, d, e, f)
            inverse[k, 0, 0], inverse[k, 1, 1], inverse[k, 2, 2] = aa, dd, ff
            inverse[k, 0, 1] = inverse[k, 1, 0] = bb
            inverse[k, 0, 2] = inverse[k, 2, 0] = cc
            inverse[k, 1, 2] = inverse[k, 2, 1] = ee
            inverse[k] /= determinant
    return inverse


def symmetric(triangle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrices (N, 3, 3) of upper triangles (N, 6), row by row."""
    return triangle[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def _theta(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least-squares planes theta . ray = inverse range; zeros where there is none."""
    theta, _ = fit_all(sums[:, :SIZE])
    theta[sums[:, COUNT] < 3] = 0
    return theta


def _total_least_squares(
    sums: NDArray[np.float64], theta: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Planes of the smallest mean square distance, in the place of those that `theta` has."""
    count = np.maximum(sums[:, COUNT], 1)
    mean = sums[:, POINT:SCATTER] / count[:, None]
    scatter = symmetric(sums[:, SCATTER:]) / count[:, None, None]
    far = np.sqrt(np.trace(scatter, axis1=1, axis2=2))
    scatter -= mean[:, :, None] * mean[:, None, :]
    normal = np.linalg.eigh(scatter)[1][:, :, 0]
    distance = -(normal * mean).sum(axis=1)
    # A plane through the sensor would be invisible: it is that of a single row of points.
    seen = theta.any(axis=1) & (np.abs(distance) > _GRAZING * far)
    return np.where(seen[:, None], -normal / np.where(seen, distance, 1)[:, None], 0)
