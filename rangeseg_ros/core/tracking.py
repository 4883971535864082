"""Ids that persist: the planes of one frame matched to those of the frames before.

Planes seen in successive frames give away how the camera moved: a rigid motion, estimated in a
least-squares sense, takes the known planes into the new frame. There they are matched by their
parameters, in standard deviations, and by the overlap of their pixels. A plane out of sight
moves along with the camera and is found again where it should be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.planes import Plane

# Rows or columns, whichever are fewer, at which overlap is looked at.
_SAMPLES = 60
# What planes of one surface differ by from frame to frame beyond their covariances, because
# their pixels are not the same: an offset, as share of the range, and an angle, at least and
# for an offset over the plane's radius.
_OFFSET, _ANGLE = 0.007, np.radians(1.0)
# Larger standard deviations do not count: what is known of such planes fits anything.
_LARGEST_OFFSET, _LARGEST_ANGLE = 0.03, np.radians(5.0)
# Area in square metres that a plane counts with at least.
_SMALLEST = 1e-4
# Largest squared distance in standard deviations, of two degrees of freedom, that may match.
_GATE = 20.0
# Overlap that planes in reach of each other count with, beside what they have.
_UNSEEN_OVERLAP = 0.1
# Standard deviations of the camera's motion between two frames: radians, metres.
_TURN, _SHIFT = np.radians(2.0), 0.03
# Least intersection over union, and largest changes, of planes the motion is estimated from.
_SURE_OVERLAP, _SURE_TURN, _SURE_SHIFT = 0.3, np.radians(15.0), 0.2
_MOTION_ROUNDS = 3


class Tracker:
    """Gives planes, and the surfaces they are parts of, ids that persist from frame to frame.

    A plane keeps its id while the camera moves and while it is out of sight for up to
    `track_memory` frames. When an occluder splits a plane, the part that overlaps most with the
    plane as it was, so in general the largest, keeps the id and the others get ids of their own.
    When parts merge, the oldest id stays, unless it belonged to a part of less than a quarter of
    the other, and the other part's id waits in the memory for the next split.

    What parts have in common is `Plane.surface`: from a frame's groups of coplanar planes it
    becomes the id of the surface, the lowest that any part has had, which persists when that
    part goes out of sight and others stay.

    No id is ever given twice in the life of a tracker, and the same input gives the same ids.

    Parameters
    ----------
    config : Config, optional
        `track_memory`.

    Examples
    --------
    >>> tracker = Tracker()
    >>> planes = tracker.track(result.labels, result.planes, stamp)
    """

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or Config()
        self._next = 1
        self._stamp = 0
        self._shape: tuple[int, ...] = ()
        self._tracks = _Tracks.of([], np.zeros(0, np.intp))

    def track(
        self, labels: NDArray[np.uint16], planes: Sequence[Plane], stamp: int
    ) -> list[Plane]:
        """The planes of the next frame with their ids.

        Parameters
        ----------
        labels : (H, W) uint16
            0 = no plane.
        planes : sequence of Plane
            As `Segmenter` returns them with `labels`.
        stamp : int
            Time of the frame, nanoseconds. A frame before the last one, as of a looped
            recording, and one of another size start anew: nothing known is matched to it.

        Returns
        -------
        list of Plane
            In the order given, `id` and `surface` set.
        """
        if stamp < self._stamp or labels.shape != self._shape:
            self._tracks = _Tracks.of([], np.zeros(0, np.intp))
        self._stamp, self._shape = stamp, labels.shape
        samples = _samples(labels, planes)
        seen, known = _Tracks.of(planes, samples), self._tracks
        shared = _shared(known, samples, len(planes))
        known = known.moved(*_camera_motion(known, seen, shared))
        distance = _distance(known, seen)
        match = _assign(known, seen, shared, distance)
        seen.id[:] = _oldest(known, match, shared, distance)
        new = seen.id == 0
        seen.id[new] = self._next + np.arange(new.sum())
        self._next += int(new.sum())
        seen.surface[:] = self._surfaces(planes, seen, known)
        lost = ~np.isin(known.id, seen.id) & (known.unseen < self.config.track_memory)
        self._tracks = seen.joined(known.where(lost).aged())
        return [
            replace(plane, id=int(i), surface=int(surface))
            for plane, i, surface in zip(planes, seen.id, seen.surface, strict=True)
        ]

    def _surfaces(self, planes: Sequence[Plane], seen: _Tracks, known: _Tracks) -> list[int]:
        """Ids of the surfaces that the planes lie on: the lowest that any part of them has had."""
        before = dict(zip(known.id.tolist(), known.surface.tolist(), strict=True))
        parts: dict[int, list[int]] = {}
        for n, plane in enumerate(planes):
            parts.setdefault(plane.surface, []).append(n)
        claims = []
        for members in parts.values():
            own = seen.id[members].tolist()
            claim = min(before.get(i, i) for i in own)
            largest = max(members, key=lambda n: planes[n].count)
            size = sum(planes[n].count for n in members)
            # Of surfaces that come apart, the one with the plane that gave the id keeps it.
            claims.append((claim not in own, -size, min(own), claim, largest, members))
        distance = _distance(seen, seen)
        holders: dict[int, int] = {}
        surfaces = [0] * len(planes)
        for _, _, own, claim, largest, members in sorted(claims):
            # Parts once found on one surface stay together for as long as they may be on one.
            for surface in (claim, own, self._next):
                if distance[holders.setdefault(surface, largest), largest] <= _GATE:
                    break
            self._next += surface == self._next
            for n in members:
                surfaces[n] = surface
        return surfaces


@dataclass(frozen=True, eq=False)
class _Tracks:
    """N planes in the frame of the camera, as arrays.

    `footprint` and `owner` list the samples of the label image in which the planes were last
    seen and whose they were, 0...N-1; `unseen` counts the frames since then. `radius` is that of
    a disc of the plane's area.
    """

    id: NDArray[np.int64]
    surface: NDArray[np.int64]
    normal: NDArray[np.float64]
    distance: NDArray[np.float64]
    covariance: NDArray[np.float64]
    centroid: NDArray[np.float64]
    radius: NDArray[np.float64]
    unseen: NDArray[np.int64]
    footprint: NDArray[np.intp]
    owner: NDArray[np.intp]

    @classmethod
    def of(cls, planes: Sequence[Plane], samples: NDArray[np.intp]) -> _Tracks:
        """Planes seen now, without ids (0)."""
        footprint = np.flatnonzero(samples)
        return cls(
            np.zeros(len(planes), np.int64),
            np.zeros(len(planes), np.int64),
            np.array([p.normal for p in planes], np.float64).reshape(-1, 3),
            np.array([p.distance for p in planes], np.float64),
            np.array([p.covariance for p in planes], np.float64).reshape(-1, 4, 4),
            np.array([p.centroid for p in planes], np.float64).reshape(-1, 3),
            np.sqrt(np.maximum([p.area for p in planes], _SMALLEST) / np.pi),
            np.zeros(len(planes), np.int64),
            footprint,
            samples[footprint] - 1,
        )

    @cached_property
    def size(self) -> NDArray[np.intp]:
        """(N,) number of samples of each plane."""
        return np.bincount(self.owner, minlength=len(self.id))

    def moved(self, rotation: NDArray[np.float64], shift: NDArray[np.float64]) -> _Tracks:
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

    def aged(self) -> _Tracks:
        """The planes one frame later, unseen."""
        return replace(self, unseen=self.unseen + 1)

    def where(self, chosen: NDArray[np.bool_]) -> _Tracks:
        """Some of the planes."""
        kept = chosen[self.owner]
        number = np.cumsum(chosen) - 1
        rest = {f.name: getattr(self, f.name)[chosen] for f in fields(self)[:-2]}
        return _Tracks(**rest, footprint=self.footprint[kept], owner=number[self.owner[kept]])

    def joined(self, others: _Tracks) -> _Tracks:
        """These planes followed by others."""
        others = replace(others, owner=others.owner + len(self.id))
        return _Tracks(
            *(np.concatenate([getattr(t, f.name) for t in (self, others)]) for f in fields(self))
        )


def _samples(labels: NDArray[np.uint16], planes: Sequence[Plane]) -> NDArray[np.intp]:
    """(S,) number of the plane in each sample of the label image, 1...N; 0 where is none."""
    step = max(min(labels.shape) // _SAMPLES, 1)
    coarse = labels[step // 2 :: step, step // 2 :: step].ravel()
    number = np.zeros(65536, np.intp)
    number[[p.label for p in planes]] = np.arange(1, len(planes) + 1)
    return number[coarse]


def _shared(known: _Tracks, samples: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """(T, N) number of samples that each known plane has in common with each one seen."""
    shape = len(known.id), count + 1
    pair = known.owner * shape[1] + samples[known.footprint]
    return np.bincount(pair, minlength=shape[0] * shape[1]).reshape(shape)[:, 1:]


def _overlap(known: _Tracks, seen: _Tracks, shared: NDArray[np.intp]) -> NDArray[np.float64]:
    """(T, N) intersection over union."""
    union = known.size[:, None] + seen.size - shared
    return shared / np.maximum(union, 1)


def _offset(known: _Tracks, seen: _Tracks) -> NDArray[np.float64]:
    """(T, N) distance of the centroids seen from the known planes, metres."""
    return known.normal @ seen.centroid.T + known.distance[:, None]


def _variances(known: _Tracks, seen: _Tracks) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(T, N) variances to expect of the angles and offsets of planes of one surface."""
    ranges = np.einsum('ni,ni->n', seen.centroid, seen.centroid)
    floor = _OFFSET**2 * ranges
    lever = np.column_stack([seen.centroid, np.ones(len(seen.id))])
    spread = np.einsum('ni,nj->nij', lever, lever).reshape(len(lever), 16)
    # h^T C h for the covariances of both planes: that of the known one at a centroid far from
    # its own is large, as it should be.
    offset = known.covariance.reshape(-1, 16) @ spread.T + floor
    offset += np.einsum('nk,nk->n', seen.covariance.reshape(-1, 16), spread)
    angle = np.add.outer(
        *(np.trace(t.covariance[:, :3, :3], axis1=1, axis2=2) for t in (known, seen))
    )
    angle += floor * np.add.outer(known.radius**-2, seen.radius**-2) + _ANGLE**2
    return np.minimum(angle, _LARGEST_ANGLE**2), np.minimum(offset, _LARGEST_OFFSET**2 * ranges)


def _distance(known: _Tracks, seen: _Tracks) -> NDArray[np.float64]:
    """(T, N) squared distance of planes in standard deviations, two degrees of freedom."""
    angle, offset = _variances(known, seen)
    cosine = np.clip(known.normal @ seen.normal.T, -1, 1)
    return np.arccos(cosine) ** 2 / angle + _offset(known, seen) ** 2 / offset


def _camera_motion(
    known: _Tracks, seen: _Tracks, shared: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation and shift that take points of the last frame to this one.

    With a small rotation w and a shift v, a plane's normal n changes by w x n and the centroid c
    of the plane that is seen comes to lie n.c + d + w.(n x c) - n.v off it: linear least squares
    over the planes that overlap most with each other, weighted by their variances, and those
    that fit badly (things that move by themselves) less. Directions in which the planes leave
    the motion open are held by a prior of zero.
    """
    overlap = _overlap(known, seen, shared) * (known.unseen == 0)[:, None]
    best = overlap == np.maximum(
        overlap.max(axis=0, initial=0)[None], overlap.max(axis=1, initial=0)[:, None]
    )
    sure = best & (overlap > _SURE_OVERLAP) & (np.abs(_offset(known, seen)) < _SURE_SHIFT)
    sure &= known.normal @ seen.normal.T > np.cos(_SURE_TURN)
    t, s = np.nonzero(sure)
    angle, offset = (variance[t, s] for variance in _variances(known, seen))
    start, distance, c = known.normal[t], known.distance[t], seen.centroid[s]
    rotation, shift = np.eye(3), np.zeros(3)
    prior = np.diag(np.repeat([_TURN**-2, _SHIFT**-2], 3))
    for _ in range(_MOTION_ROUNDS):
        n = start @ rotation.T
        turn, lever = np.cross(n, np.stack([seen.normal[s], c]))
        gap = np.einsum('ni,ni->n', n, c - shift) + distance
        weight = 1 / (1 + (np.einsum('ni,ni->n', turn, turn) / angle + gap**2 / offset) / 4)
        # For w x n = n' - n the normal equations are (I - n n^T) w = n x n'.
        across = np.eye(3) * (weight / angle).sum() - (n.T * (weight / angle)) @ n
        slope = np.hstack([lever, -n])
        left = prior + (slope.T * (weight / offset)) @ slope
        left[:3, :3] += across
        right = -(weight / offset * gap) @ slope
        right[:3] += (weight / angle) @ turn
        step = np.linalg.solve(left, right)
        twist = cv2.Rodrigues(step[:3])[0]
        rotation, shift = twist @ rotation, twist @ shift + step[3:]
    return rotation, shift


def _assign(
    known: _Tracks,
    seen: _Tracks,
    shared: NDArray[np.intp],
    distance: NDArray[np.float64],
) -> NDArray[np.intp]:
    """(N,) number of the known plane that each plane is, -1 for none."""
    between = np.linalg.norm(known.centroid[:, None] - seen.centroid, axis=2)
    near = (shared > 0) | (between < known.radius[:, None] + seen.radius)
    # Little without overlap, or two bad pairs would be worth more than one that is sure.
    affinity = (_overlap(known, seen, shared) + _UNSEEN_OVERLAP) * np.exp(-distance / 8)
    affinity[~near | (distance > _GATE)] = 0
    rows, columns = linear_sum_assignment(affinity, maximize=True)
    match = np.full(len(seen.id), -1)
    match[columns] = np.where(affinity[rows, columns] > 0, rows, -1)
    return match


def _oldest(
    known: _Tracks,
    match: NDArray[np.intp],
    shared: NDArray[np.intp],
    distance: NDArray[np.float64],
) -> NDArray[np.int64]:
    """(N,) ids of the matched planes, 0 for the others; of merged parts the lowest id."""
    matched = np.flatnonzero(match >= 0)
    kept = match[matched]
    free = known.unseen == 0
    free[kept] = False
    merged = free[:, None] & (2 * shared > known.size[:, None])[:, matched]
    merged &= (distance <= _GATE)[:, matched] & (4 * known.size[:, None] >= known.size[kept])
    parts = np.where(merged, known.id[:, None], known.id[kept])
    ids = np.zeros(len(match), np.int64)
    if len(kept):
        ids[matched] = parts.min(axis=0)
    return ids
