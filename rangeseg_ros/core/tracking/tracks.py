"""Planes of successive frames side by side: as arrays, and how well they fit each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.description.planes import Plane

# Rows or columns, whichever are fewer, at which overlap is looked at: a plane of the least size
# has about eight samples in a 640 x 480 image.
_SAMPLES = 60
# What planes of one surface differ by from frame to frame beyond their covariances, because
# their pixels are not the same: an offset, as share of the range (of 2 m, half of what the
# distortion of a Kinect is there), and an angle, at least and for an offset over the plane's
# radius.
OFFSET, ANGLE = 0.007, np.radians(1.0)
SURE_TURN, FARTHEST = np.radians(15.0), 0.1
"""Largest angle, and offset as share of the range, of what may be one plane from frame to frame.

Beyond is no error of the sensor but another plane, however uncertain both are.
"""
# Larger standard deviations do not count: what is known of such planes fits anything.
_LARGEST_OFFSET, _LARGEST_ANGLE = FARTHEST / 3, SURE_TURN / 3
# Area in square metres that a plane counts with at least, so that its radius is not 0.
_SMALLEST = 1e-4


@dataclass(frozen=True, eq=False)
class Tracks:
    """N planes in the frame of the camera, as arrays.

    `footprint` and `owner` list the samples of the label image in which the planes were last
    seen and whose they were, 0...N-1; `age` is for how many seconds they were seen, `unseen` how
    many have passed since then. `radius` is that of a disc of the plane's area, `reach` that of
    one around it.
    """

    id: NDArray[np.int64]
    surface: NDArray[np.int64]
    normal: NDArray[np.float64]
    distance: NDArray[np.float64]
    covariance: NDArray[np.float64]
    centroid: NDArray[np.float64]
    radius: NDArray[np.float64]
    reach: NDArray[np.float64]
    age: NDArray[np.float64]
    unseen: NDArray[np.float64]
    footprint: NDArray[np.intp]
    owner: NDArray[np.intp]

    @classmethod
    def of(
        cls, planes: Sequence[Plane], samples: NDArray[np.intp], elapsed: float = 0.0
    ) -> Tracks:
        """Planes seen now, for `elapsed` seconds so far, without ids (0)."""
        footprint = np.flatnonzero(samples)
        return cls(
            np.zeros(len(planes), np.int64),
            np.zeros(len(planes), np.int64),
            np.array([p.normal for p in planes], np.float64).reshape(-1, 3),
            np.array([p.distance for p in planes], np.float64),
            np.array([p.covariance for p in planes], np.float64).reshape(-1, 4, 4),
            np.array([p.centroid for p in planes], np.float64).reshape(-1, 3),
            np.sqrt(np.maximum([p.area for p in planes], _SMALLEST) / np.pi),
            np.linalg.norm([p.extents for p in planes] or np.zeros((0, 2)), axis=1) / 2,
            np.full(len(planes), elapsed),
            np.zeros(len(planes)),
            footprint,
            samples[footprint] - 1,
        )

    @cached_property
    def size(self) -> NDArray[np.intp]:
        """(N,) number of samples of each plane."""
        return np.bincount(self.owner, minlength=len(self.id))

    @cached_property
    def spread(self) -> NDArray[np.float64]:
        """(N, 16) h h^T of h = (centroid, 1): h^T C h is the variance of the offset there."""
        lever = np.column_stack([self.centroid, np.ones(len(self.id))])
        return (lever[:, :, None] * lever[:, None]).reshape(-1, 16)

    @cached_property
    def offset_variance(self) -> NDArray[np.float64]:
        """(N,) variance of the offset of each plane at its own centroid."""
        result: NDArray[np.float64]
        result = np.einsum('nk,nk->n', self.covariance.reshape(-1, 16), self.spread)
        return result

    @cached_property
    def angle_variance(self) -> NDArray[np.float64]:
        """(N,) variance of the angle of each plane."""
        diagonal = np.einsum('nii->ni', self.covariance)
        return diagonal[:, 0] + diagonal[:, 1] + diagonal[:, 2]

    @cached_property
    def apart(self) -> NDArray[np.float64]:
        """(N, N) `distances` of the planes from each other."""
        return distances(self, self)

    def moved(self, rotation: NDArray[np.float64], shift: NDArray[np.float64]) -> Tracks:
        """The planes in a frame in which x is at rotation x + shift."""
        jacobian = np.eye(4)
        jacobian[:3, :3] = rotation
        jacobian[3, :3] = -shift @ rotation
        normal = self.normal @ rotation.T
        return replace(
            self,
            normal=normal,
            distance=self.distance - normal @ shift,
            covariance=jacobian @ self.covariance @ jacobian.T,
            centroid=self.centroid @ rotation.T + shift,
        )

    def aged(self, elapsed: float) -> Tracks:
        """The planes `elapsed` seconds later, unseen."""
        return replace(self, unseen=self.unseen + elapsed)

    def where(self, chosen: NDArray[np.bool_]) -> Tracks:
        """Some of the planes."""
        kept = chosen[self.owner]
        number = np.cumsum(chosen) - 1
        rest = {f.name: getattr(self, f.name)[chosen] for f in fields(self)[:-2]}
        return Tracks(**rest, footprint=self.footprint[kept], owner=number[self.owner[kept]])

    def joined(self, others: Tracks) -> Tracks:
        """These planes followed by others."""
        others = replace(others, owner=others.owner + len(self.id))
        return Tracks(
            *(np.concatenate([getattr(t, f.name) for t in (self, others)]) for f in fields(self))
        )


def samples_of(labels: NDArray[np.uint16], planes: Sequence[Plane]) -> NDArray[np.intp]:
    """(S,) number of the plane in each sample of the label image, 1...N; 0 where is none."""
    step = max(min(labels.shape) // _SAMPLES, 1)
    coarse = labels[step // 2 :: step, step // 2 :: step].ravel()
    number = np.zeros(65536, np.intp)
    number[[p.label for p in planes]] = np.arange(1, len(planes) + 1)
    return number[coarse]


def shared_samples(known: Tracks, samples: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """(T, N) number of samples that each known plane has in common with each one seen."""
    shape = len(known.id), count + 1
    pair = known.owner * shape[1] + samples[known.footprint]
    return np.bincount(pair, minlength=shape[0] * shape[1]).reshape(shape)[:, 1:]


def overlaps(known: Tracks, seen: Tracks, shared: NDArray[np.intp]) -> NDArray[np.float64]:
    """(T, N) intersection over union."""
    union = known.size[:, None] + seen.size - shared
    return shared / np.maximum(union, 1)


def offsets(known: Tracks, seen: Tracks) -> NDArray[np.float64]:
    """(T, N) distance of the centroids seen from the known planes, metres."""
    return known.normal @ seen.centroid.T + known.distance[:, None]


def variances(known: Tracks, seen: Tracks) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(T, N) variances to expect of the angles and offsets of planes of one surface."""
    ranges = np.einsum('ni,ni->n', seen.centroid, seen.centroid)
    floor = OFFSET**2 * ranges
    # h^T C h for the covariances of both planes: that of the known one at a centroid far from
    # its own is large, as it should be.
    offset = known.covariance.reshape(-1, 16) @ seen.spread.T + floor
    offset += seen.offset_variance
    angle = np.add.outer(known.angle_variance, seen.angle_variance)
    angle += floor * np.add.outer(known.radius**-2, seen.radius**-2) + ANGLE**2
    return np.minimum(angle, _LARGEST_ANGLE**2), np.minimum(offset, _LARGEST_OFFSET**2 * ranges)


def distances(known: Tracks, seen: Tracks) -> NDArray[np.float64]:
    """(T, N) squared distance of planes in standard deviations, two degrees of freedom."""
    angle, offset = variances(known, seen)
    cosine = np.clip(known.normal @ seen.normal.T, -1, 1)
    return np.arccos(cosine) ** 2 / angle + offsets(known, seen) ** 2 / offset


def are_near(
    known: Tracks, seen: Tracks, shared: NDArray[np.intp], size: str
) -> NDArray[np.bool_]:
    """(T, N) whether planes overlap, or circles of their `size` (radius or reach) do."""
    between = np.linalg.norm(known.centroid[:, None] - seen.centroid, axis=2)
    return (shared > 0) | (between < np.add.outer(getattr(known, size), getattr(seen, size)))
