"""Least-squares planes of regions, and how far they may be off."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rangeseg_ros.core.arrays import Floats, Mask
from rangeseg_ros.core.fitting.region_sums import POINT, SCATTER, RegionSums, fit_sums
from rangeseg_ros.core.fitting.uncertainty import covariance_roots, levels
from rangeseg_ros.core.sensing.moments import COUNT, SYMMETRIC, cofactors
from rangeseg_ros.core.sensing.sensor import SensorModel

# Sine of the angle at which no surface is seen any more.
_GRAZING = 1e-3


class Fits(NamedTuple):
    """Planes theta . ray = inverse range (M + 1, 3) of regions; zeros where there is none.

    `sums` are over the pixels that were fitted, `total` (M + 1, 29) the same of whole regions.
    `level` (N,) is the inverse range of the planes at the middles of their cells.
    """

    sums: RegionSums
    total: Floats
    theta: Floats
    sensor: SensorModel
    level: Floats

    @classmethod
    def of(cls, sums: RegionSums, sensor: SensorModel, cloud: bool) -> Fits:
        """Fit a plane to every region.

        By weighted least squares in inverse range, where a plane is linear and the error of a
        camera lies. An organised `cloud` tells neither its sensor's centre nor the direction of
        its errors; there the plane is that of total least squares of the points.
        """
        total = sums.total()
        theta = _total_least_squares(total, fit_sums(total)) if cloud else fit_sums(total)
        return cls(sums, total, theta, sensor, levels(sums, theta))

    def without(self, dropped: Mask) -> Fits:
        """Those of regions that are not `dropped` (M + 1,), never 0, numbered anew."""
        kept, sums = ~dropped, self.sums.without(dropped)
        level = self.level[kept[self.sums.owners]]
        return Fits(sums, self.total[kept], self.theta[kept], self.sensor, level)

    def farthest(self) -> Floats:
        """Least inverse range (M + 1,) of planes in their regions; 0 or less where none ends."""
        least = np.where(np.diff(self.sums.start) > 0, np.inf, 0.0)
        np.minimum.at(least, self.sums.owners, self.level)
        return least

    def roots(self) -> Floats:
        """Roots (M + 1, 3, 3) of the covariances of the planes, zeros where there is none."""
        known: Mask = np.asarray(self.theta.any(axis=1))
        *entries, determinant = cofactors(*self.total[:, :6].T)
        inverse = np.where(known, entries, 0) / np.where(known, determinant, 1)
        return covariance_roots(self.sums, self.level, inverse.T[:, SYMMETRIC], self.sensor)


def _total_least_squares(total: Floats, theta: Floats) -> Floats:
    """Planes of the smallest mean square distance, in the place of those that `theta` has."""
    count = np.maximum(total[:, COUNT], 1)
    mean = total[:, POINT:SCATTER] / count[:, None]
    scatter = (total[:, SCATTER : SCATTER + 6] / count[:, None])[:, SYMMETRIC]
    far = np.sqrt(np.trace(scatter, axis1=1, axis2=2))
    normal = np.linalg.eigh(scatter - mean[:, :, None] * mean[:, None])[1][:, :, 0]
    distance = -(normal * mean).sum(axis=1)
    # A plane through the sensor would be invisible: it is that of a single row of points.
    seen = theta.any(axis=1) & (np.abs(distance) > _GRAZING * far)
    return np.where(seen[:, None], -normal / np.where(seen, distance, 1)[:, None], 0)
