"""Where surfaces end: points at jump edges, and what these tell of a camera's motion.

Where planes leave a motion open, the ends of what is in sight close it. Each point of the frame
before is looked for among those of the next one (iterated closest points; Besl and McKay, TPAMI
1992). It tells of the motion across its edge and the ray: along an edge its points look alike.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rangeseg_ros.core.arrays import Floats, Indices
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sensing.enlargement import Cells
from rangeseg_ros.core.sensing.grid import GridEdges
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.significance import CAUCHY, chi2_quantile

# Points that tell the direction of an edge.
_NEIGHBOURS = 8
# Points along an edge taken as fully correlated; NEES is then about 1 in simulated rooms.
_CORRELATED = 32
_ROUNDS, _GATE = 4, chi2_quantile(1)
_DEVIATION = 1.4826  # of Gaussian errors, over their median absolute value


class JumpPoints(NamedTuple):
    """The near sides of the jump edges of an image: points (N, 3), metres, from the sensor.

    `width` is that of the squares that they are known to, radians.
    """

    points: Floats
    width: float

    @classmethod
    def of(cls, image: RangeImage, jumps: GridEdges | None, cells: Cells | None) -> JumpPoints:
        """Those of an image, by its `jumps` between pixels, or between the `cells` of these."""
        if jumps is None:
            return cls(np.zeros((0, 3)), 0.0)
        image = cells.reduced(image) if cells else image
        inverse, near = image.inverse, np.zeros(image.shape, np.bool_)
        # The same arrays with columns, then rows, for their last axis.
        for jump, y, mark in ((jumps[0], inverse, near), (jumps[1].T, inverse.T, near.T)):
            before, after = y[:, :-1], y[:, 1:]
            mark[:, :-1] |= jump & (before > after) & (after > 0)
            mark[:, 1:] |= jump & (after > before) & (before > 0)
        points = image.rays[near].astype(np.float64) / inverse[near][:, None]
        return cls(points, image.pixel_area**0.5)

    def motion(
        self, last: JumpPoints, before: Transform, pose: Transform, prior: Floats
    ) -> tuple[Floats, Floats]:
        """What these points tell of the errors of the poses `pose` and `before`, of the `last`.

        The errors are turns in the camera's axes and shifts, (12,), `prior` (12, 12) is their
        covariance. Returns a design (R, 12) and values (R,), design @ errors = values, of unit
        variance.
        """
        design, values = np.zeros((0, 12)), np.zeros(0)
        if min(len(last.points), len(self.points)) < 2 * _NEIGHBOURS:
            return design, values
        # Here, as it takes longer to import than to segment a frame.
        from scipy.spatial import cKDTree

        tree = cKDTree(self.points)
        across = self._across(tree.query(self.points, _NEIGHBOURS)[1])
        least = np.hypot(self.width, last.width) / np.sqrt(12)
        error, deviation, limit = np.zeros(12), least, np.inf
        for _ in range(_ROUNDS):
            there, here = before.by(error[6:]), pose.by(error[:6])
            back = here.inverse()
            points = back.after(there).apply(last.points)
            place = tree.query(points)[1]
            gap = (across[place] * (self.points[place] - points)).sum(axis=1)
            then = across[place] @ back.rotation @ there.rotation
            moved = np.cross(across[place], points), across[place] @ -back.rotation
            origin = np.cross(last.points, then), across[place] @ back.rotation
            slope = np.hstack([*moved, *origin])
            expected = ((slope @ prior) * slope).sum(axis=1) + deviation**2
            # Cauchy's weights, once it is known how the points scatter: those that are hidden in
            # one of the images have no counterpart.
            weight = 1 / (1 + (gap / limit) ** 2)
            # As seen from the poses that were given.
            gap += slope @ error
            known = gap**2 < _GATE * expected
            weight *= known / (_CORRELATED * deviation**2)
            scale, axes = np.linalg.eigh((slope * weight[:, None]).T @ slope)
            large = scale > 1e-9 * scale[-1]
            design = np.sqrt(scale[large])[:, None] * axes.T[large]
            values = (axes.T[large] @ (slope.T @ (weight * gap))) / np.sqrt(scale[large])
            gain = prior @ design.T
            error = gain @ np.linalg.solve(design @ gain + np.eye(len(values)), values)
            left = np.abs(gap - slope @ error)[known]
            if len(left) > 2 * _NEIGHBOURS:
                deviation = max(_DEVIATION * float(np.median(left)), least)
            limit = CAUCHY * deviation
        return design, values

    def _across(self, neighbours: Indices) -> Floats:
        """Directions (N, 3) across the edges and rays, over the range, by `neighbours` (N, K)."""
        near = self.points[neighbours]
        near -= near.mean(axis=1, keepdims=True)
        along = np.linalg.eigh(near.transpose(0, 2, 1) @ near)[1][..., -1]
        across = np.cross(self.points, along)
        size = np.linalg.norm(across, axis=1) * np.linalg.norm(self.points, axis=1)
        return across / np.maximum(size, 1e-12)[:, None]
