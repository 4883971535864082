"""Ids that persist: the planes of one frame matched to those of the frames before.

Planes seen in successive frames give away how the camera moved: a rigid motion, estimated in a
least-squares sense, takes the known planes into the new frame. There they are matched by their
parameters, in standard deviations, and by the overlap of their pixels. A plane out of sight
moves along with the camera and is found again where it should be.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.rotations import cross_products
from rangeseg_ros.core.significance import chi2_quantile
from rangeseg_ros.core.tracking.tracks import (
    SURE_TURN,
    Tracks,
    are_near,
    distances,
    offsets,
    overlaps,
    samples_of,
    shared_samples,
    variances,
)

# Largest squared distance in standard deviations that may match: of two degrees of freedom, one
# of 22000 matches is beyond.
_GATE = 20.0
# Intersection over union that planes in reach of each other count with, beside what they have: a
# plane that has just come out of hiding overlaps with nothing, and one in sight overlaps more.
_UNSEEN_OVERLAP = 0.1
# Seconds in which a plane must have been seen to be as good as older ones, and what it counts
# with until then: what looks like a new plane at first may be a part of one that is about to go.
# It counts less than an older one out of sight.
_TRIAL, _ON_TRIAL = 0.32, _UNSEEN_OVERLAP / 2
# Seconds between frames that stamps which do not tell (the same, or none) stand for; and what that
# speed is kept up for, as hands and heads change their minds about that often.
NOMINAL, PERSISTENCE = 1 / 30, 0.5
# The equations of the motion are linear in it.
_MOTION_ROUNDS = 3
# Chi-squared with the six degrees of freedom of a motion.
_JUMP = chi2_quantile(6)


class Jump(NamedTuple):
    """What a motion that was told differs by from that of the planes: metres and radians."""

    shift: float
    turn: float

    @classmethod
    def between(
        cls,
        told: tuple[NDArray[np.float64], NDArray[np.float64]],
        own: tuple[NDArray[np.float64], NDArray[np.float64]],
    ) -> Jump:
        """Of two motions, rotation (3, 3) and shift (3,)."""
        turn = told[0] @ own[0].T
        angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
        return cls(float(np.linalg.norm(told[1] - turn @ own[1])), float(angle))

    def __str__(self) -> str:
        return (
            f'the planes contradict the pose by {1e3 * self.shift:.0f} mm and '
            f'{np.degrees(self.turn):.1f} degrees'
        )


class Tracker:
    """Gives planes, and the surfaces they are parts of, ids that persist from frame to frame.

    A plane keeps its id while the camera moves and while it is out of sight for up to
    `track_time` seconds. When an occluder splits a plane, the part that overlaps most with the
    plane as it was, so in general the largest, keeps the id and the others get ids of their own.
    When parts merge, the oldest id stays, unless it belonged to a part of less than a quarter of
    the other, and the other part's id waits in the memory for the next split. Of a face seen in
    scraps that come and go, one has the oldest id for as long as any is in sight.

    What parts have in common is `Plane.surface`: from a frame's groups of coplanar planes it
    becomes the id of the surface, the lowest that any part has had, which persists when that
    part goes out of sight and others stay.

    No id is ever given twice in the life of a tracker, and the same input gives the same ids.

    Parameters
    ----------
    config : Config, optional
        `track_time`, `camera_turn` and `camera_speed`.

    Attributes
    ----------
    jump : Jump or None
        How far the motion that was told of the last frame is from that of the planes, where they
        contradict it.

    Examples
    --------
    >>> tracker = Tracker()
    >>> planes = tracker.track(result.labels, result.planes, stamp)
    """

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or Config()
        self.jump: Jump | None = None
        self._next = 1
        self._stamp = 0
        self._shape: tuple[int, ...] = ()
        self.reset()

    def reset(self) -> None:
        """Forget the planes: none of them is matched. Their ids are not given again."""
        self._tracks = Tracks.of([], np.zeros(0, np.intp))

    def track(
        self,
        labels: NDArray[np.uint16],
        planes: Sequence[Plane],
        stamp: int,
        motion: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    ) -> list[Plane]:
        """The planes of the next frame with their ids.

        Parameters
        ----------
        labels : (H, W) uint16
            0 = no plane.
        planes : sequence of Plane
            As `Segmenter` returns them with `labels`.
        stamp : int
            Time of the frame, nanoseconds, not before that of the last one. A frame of another
            size starts anew: nothing known is matched to it.
        motion : (3, 3) and (3,) float64, optional
            Rotation and shift that take points of the last frame to this one, where they are
            known; the planes tell the rest.

        Returns
        -------
        list of Plane
            In the order given, `id` and `surface` set.
        """
        self.jump = None
        if labels.shape != self._shape:
            self.reset()
        elapsed = (stamp - self._stamp) * 1e-9 if stamp > self._stamp > 0 else NOMINAL
        self._stamp, self._shape = stamp, labels.shape
        samples = samples_of(labels, planes)
        seen, known = Tracks.of(planes, samples, elapsed), self._tracks
        shared = shared_samples(known, samples, len(planes))
        speed = np.array([np.radians(self.config.camera_turn), self.config.camera_speed])
        reach = min(max(elapsed, NOMINAL), PERSISTENCE)
        if motion:
            # Where the frames that tell the motion jump, the planes know better.
            noise = np.radians(self.config.pose_turn_noise), self.config.pose_noise
            own = _camera_motion(known, seen, shared, speed, reach)
            if _contradiction(known, seen, shared, speed, motion, own, noise) > _JUMP:
                self.jump = Jump.between(motion, own)
            else:
                known = known.moved(*motion)
        known = known.moved(*_camera_motion(known, seen, shared, speed, reach))
        distance = distances(known, seen)
        match = _assign(known, seen, shared, distance)
        seen.id[:] = _oldest(known, match, shared, distance)
        _inherit(planes, seen, known, shared, distance)
        s, t = np.nonzero(seen.id[:, None] == known.id)
        seen.age[s] += known.age[t]
        new = seen.id == 0
        seen.id[new] = self._next + np.arange(new.sum())
        self._next += int(new.sum())
        seen.surface[:] = self._surfaces(planes, seen, known)
        lost = ~np.isin(known.id, seen.id) & (known.unseen + elapsed <= self.config.track_time)
        self._tracks = seen.joined(known.where(lost).aged(elapsed))
        return [
            plane.named(id=i, surface=surface)
            for plane, i, surface in zip(
                planes, seen.id.tolist(), seen.surface.tolist(), strict=True
            )
        ]

    def _surfaces(self, planes: Sequence[Plane], seen: Tracks, known: Tracks) -> list[int]:
        """Ids of the surfaces that the planes lie on: the lowest that any part of them has had."""
        before = dict(zip(known.id.tolist(), known.surface.tolist(), strict=True))
        claims = []
        for members in _groups(planes):
            own = seen.id[members].tolist()
            claim = min(before.get(i, i) for i in own)
            largest = max(members, key=lambda n: planes[n].count)
            size = sum(planes[n].count for n in members)
            # Of surfaces that come apart, the one with the plane that gave the id keeps it.
            claims.append((claim not in own, -size, min(own), claim, largest, members))
        holders: dict[int, int] = {}
        surfaces = [0] * len(planes)
        for _, _, own, claim, largest, members in sorted(claims):
            # Parts once found on one surface stay together for as long as they may be on one.
            for surface in (claim, own, self._next):
                holder = holders.setdefault(surface, largest)
                if holder == largest or seen.apart[holder, largest] <= _GATE:
                    break
            self._next += surface == self._next
            for n in members:
                surfaces[n] = surface
        return surfaces


def _groups(planes: Sequence[Plane]) -> list[list[int]]:
    """Numbers of the planes that lie on one surface, for each surface of a frame."""
    parts: dict[int, list[int]] = {}
    for n, plane in enumerate(planes):
        parts.setdefault(plane.surface, []).append(n)
    return list(parts.values())


def _camera_motion(
    known: Tracks,
    seen: Tracks,
    shared: NDArray[np.intp],
    speed: NDArray[np.float64],
    reach: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation and shift that take points of the last frame to this one.

    With a small rotation w and a shift v, a plane's normal n changes by w x n and the centroid c
    of the plane that is seen comes to lie n.c + d + w.(n x c) - n.v off it: linear least squares
    over the planes that have most of their pixels in common, weighted by their variances, and
    those that fit badly (things that move by themselves) less. Directions in which the planes
    leave the motion open are held by a prior of zero, with standard deviations of `reach` seconds
    at `speed`, radians and metres per second.
    """
    t, s = np.nonzero(_sure_pairs(known, seen, shared, speed))
    angle, offset = (variance[t, s] for variance in variances(known, seen))
    start, distance = known.normal[t], known.distance[t]
    end, c = seen.normal[s], seen.centroid[s]
    rotation, shift = np.eye(3), np.zeros(3)
    prior = np.diag(np.repeat((reach * speed) ** -2.0, 3))
    for _ in range(_MOTION_ROUNDS):
        n = start @ rotation.T
        turn, lever = cross_products(n, end), cross_products(n, c)
        gap = np.einsum('ni,ni->n', n, c - shift) + distance
        weight = 1 / (1 + (np.einsum('ni,ni->n', turn, turn) / angle + gap**2 / offset) / 4)
        # For w x n = n' - n the normal equations are (I - n n^T) w = n x n'.
        across = np.eye(3) * (weight / angle).sum() - (n.T * (weight / angle)) @ n
        slope = np.concatenate([lever, -n], axis=1)
        left = prior + (slope.T * (weight / offset)) @ slope
        left[:3, :3] += across
        right = -(weight / offset * gap) @ slope
        right[:3] += (weight / angle) @ turn
        step = np.linalg.solve(left, right)
        twist = cv2.Rodrigues(step[:3])[0]
        rotation, shift = twist @ rotation, twist @ shift + step[3:]
    return rotation, shift


def _contradiction(
    known: Tracks,
    seen: Tracks,
    shared: NDArray[np.intp],
    speed: NDArray[np.float64],
    told: tuple[NDArray[np.float64], NDArray[np.float64]],
    own: tuple[NDArray[np.float64], NDArray[np.float64]],
    noise: tuple[float, float],
) -> float:
    """How much better, in chi-squared, the planes are explained by another motion than told.

    That of the plane for which it is most does not count where there are others: it may be one
    that moves by itself.
    `noise` is that of the poses that tell the motion, radians and metres.
    """
    t, s = np.nonzero(_sure_pairs(known, seen, shared, speed))
    if not len(t):
        return 0.0
    angle, offset = (variance[t, s] for variance in variances(known, seen))
    lever = np.einsum('ni,ni->n', seen.centroid[s], seen.centroid[s])
    gains = np.zeros(len(t))
    for sign, (rotation, shift), (turn, place) in ((1, told, noise), (-1, own, (0.0, 0.0))):
        n, c = known.normal[t] @ rotation.T, seen.centroid[s]
        gap = np.einsum('ni,ni->n', n, c - shift) + known.distance[t]
        across = cross_products(n, seen.normal[s])
        square = np.einsum('ni,ni->n', across, across) / (angle + 2 * turn**2)
        square += gap**2 / (offset + 2 * place**2 + 2 * turn**2 * lever)
        gains += sign * square
    return float(gains.sum() - (gains.max() if len(gains) > 1 else 0.0))


def _sure_pairs(
    known: Tracks, seen: Tracks, shared: NDArray[np.intp], speed: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """(T, N) whether planes have half of their pixels in common, and agree.

    Larger changes than a turn of `SURE_TURN`, and a shift in the time of such a turn, are rather
    another plane.
    """
    most = 2 * shared > np.maximum(known.size[:, None], seen.size)
    most &= (known.unseen == 0)[:, None]
    shift = SURE_TURN / speed[0] * speed[1]
    sure = most & (np.abs(offsets(known, seen)) < shift)
    result: NDArray[np.bool_] = sure & (known.normal @ seen.normal.T > np.cos(SURE_TURN))
    return result


def _assign(
    known: Tracks,
    seen: Tracks,
    shared: NDArray[np.intp],
    distance: NDArray[np.float64],
) -> NDArray[np.intp]:
    """(N,) number of the known plane that each plane is, -1 for none."""
    # Here, as it takes as long to import as a frame and is for sequences only.
    from scipy.optimize import linear_sum_assignment

    # Little without overlap, or two bad pairs would be worth more than one that is sure.
    affinity = (overlaps(known, seen, shared) + _UNSEEN_OVERLAP) * np.exp(-distance / 8)
    affinity[known.age < _TRIAL] *= _ON_TRIAL
    affinity[~are_near(known, seen, shared, 'reach') | (distance > _GATE)] = 0
    rows, columns = linear_sum_assignment(affinity, maximize=True)
    match = np.full(len(seen.id), -1)
    match[columns] = np.where(affinity[rows, columns] > 0, rows, -1)
    return match


def _oldest(
    known: Tracks,
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


def _inherit(
    planes: Sequence[Plane],
    seen: Tracks,
    known: Tracks,
    shared: NDArray[np.intp],
    distance: NDArray[np.float64],
) -> None:
    """Let a part in sight have the id of its surface when the part that had it is lost.

    The two parts exchange their ids, so that the lost one is found again by the other's. They
    are to be close, as scraps of a grazing face are: things far apart on one plane are things of
    their own. And no large part is renamed after a sliver.
    """

    @cache
    def near() -> NDArray[np.bool_]:
        close = are_near(known, seen, shared, 'radius') & (distance <= _GATE)
        result: NDArray[np.bool_] = close & (4 * known.size[:, None] >= seen.size)
        return result

    surface = dict(zip(known.id.tolist(), known.surface.tolist(), strict=True))
    ids = seen.id.tolist()
    for members in _groups(planes):
        claim = min((surface[ids[n]] for n in members if ids[n]), default=0)
        if claim in ids or not (known.id == claim).any():
            continue
        lost = int(np.flatnonzero(known.id == claim)[0])
        heirs = [n for n in members if near()[lost, n]]
        if not heirs:
            continue
        heir = max(heirs, key=lambda n: (shared[lost, n], planes[n].count))
        own = known.id == ids[heir]
        known.id[lost], known.id[own], ids[heir] = ids[heir], claim, claim
    seen.id[:] = ids
