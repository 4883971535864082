"""Ids that persist: the planes of one frame matched to those of the frames before.

Planes seen in successive frames give away how the camera moved: a rigid motion, estimated in a
least-squares sense, takes the known planes into the new frame. There they are matched by the gate
of `plane_errors` and by the overlap of their pixels. A plane out of sight moves along with the
camera and is found again where it should be.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Indices, Labels, Mask
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.rotations import rotation_by
from rangeseg_ros.core.tracking.plane_errors import (
    GATE,
    NARROWEST,
    by_motion,
    candidates,
    congruent,
    mahalanobis,
    moved_plane,
    tangents,
    to_errors,
    with_floor,
)

# Overlap that is added to the intersection over union of all planes within reach, so that a plane
# that has just come out of hiding can be matched, and one that overlaps is preferred.
_UNSEEN_OVERLAP = 0.1
# Seconds between frames whose stamps are equal or missing, and the time for which hands and heads
# keep their velocity.
NOMINAL, PERSISTENCE = 1 / 30, 0.5
# The equations of the motion are nearly linear in it: rounds at most, and the squared step, in
# variances of the motion, that changes nothing any more.
_MOTION_ROUNDS, _SETTLED = 3, 0.01
# Rows or columns, whichever are fewer, at which overlap is looked at: a plane of the least size
# has about eight samples in a 640 x 480 image.
_SAMPLES = 60
Motion = tuple[Floats, Floats]
"""Rotation (3, 3) and shift (3,) that take points of one frame to another."""


class Tracks(NamedTuple):
    """N planes in the frame of the camera."""

    id: NDArray[np.int64]
    surface: NDArray[np.int64]
    plane: Floats  # (N, 4), normals and distances
    covariance: Floats  # (N, 4, 4)
    centroid: Floats  # (N, 3)
    width: Floats  # half of that of the rectangle around each plane, metres
    reach: Floats  # half of its diagonal
    unseen: Floats  # seconds since they were last seen
    mask: Mask  # (N, S), in which samples of the label image that was

    @classmethod
    def of(cls, planes: Sequence[Plane], labels: Labels) -> Tracks:
        """Planes seen now in a label image (H, W), without ids (0)."""
        step = max(min(labels.shape) // _SAMPLES, 1)
        coarse = labels[step // 2 :: step, step // 2 :: step].ravel()
        own = np.array([p.label for p in planes], np.uint16)
        extents = np.array([p.extents for p in planes], np.float64).reshape(-1, 2)
        return cls(
            np.zeros(len(planes), np.int64),
            np.zeros(len(planes), np.int64),
            np.array([[*p.normal, p.distance] for p in planes], np.float64).reshape(-1, 4),
            np.array([p.covariance for p in planes], np.float64).reshape(-1, 4, 4),
            np.array([p.centroid for p in planes], np.float64).reshape(-1, 3),
            np.maximum(extents.min(axis=1, initial=np.inf) / 2, NARROWEST),
            np.asarray(np.linalg.norm(extents, axis=1)) / 2,
            np.zeros(len(planes)),
            coarse == own[:, None],
        )

    @property
    def size(self) -> Indices:
        """(N,) number of samples of each plane."""
        return self.mask.sum(axis=1)

    def shared(self, others: Tracks) -> Indices:
        """(N, M) samples in common with the planes of one image, which have none in common.

        Counted, as a product of matrices wakes all threads of the linear algebra, which then spin.
        """
        count = len(others.id)
        number = np.arange(1, count + 1) @ others.mask
        counts = [np.bincount(number[own], minlength=count + 1)[1:] for own in self.mask]
        return np.array(counts, np.intp).reshape(len(self.id), count)

    @property
    def range(self) -> Floats:
        """(N,) distances of the centroids from the camera, metres."""
        return np.asarray(np.linalg.norm(self.centroid, axis=1))

    def moved(self, rotation: Floats, shift: Floats) -> Tracks:
        """The planes in a frame in which x is at rotation x + shift."""
        jacobian = moved_plane(rotation, shift)
        return self._replace(
            plane=self.plane @ jacobian.T,
            covariance=congruent(jacobian, self.covariance),
            centroid=self.centroid @ rotation.T + shift,
        )

    def where(self, chosen: Mask) -> Tracks:
        """Some of the planes."""
        return Tracks._make(part[chosen] for part in self)

    def joined(self, others: Tracks) -> Tracks:
        """These planes followed by others."""
        pairs: Any = zip(self, others, strict=True)
        return Tracks._make(np.concatenate(pair) for pair in pairs)


class Tracker:
    """Gives planes, and the surfaces they are parts of, ids that persist from frame to frame.

    A plane keeps its id while the camera moves and while it is out of sight for up to
    `track_time` seconds. When an occluder splits a plane, the part that overlaps most with the
    plane as it was, so in general the largest, keeps the id and the others get ids of their own.
    When parts merge, the id of the part that overlaps most stays, and the others wait in the
    memory for the next split.

    What parts have in common is `Plane.surface`: from a frame's groups of coplanar planes it
    becomes the id of the surface, the lowest that any part has had, which persists when that
    part goes out of sight and others stay.

    No id is ever given twice in the life of a tracker, and the same input gives the same ids. Of
    the parameters, `track_time`, `camera_turn` and `camera_speed` count.
    """

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or Config()
        self._next = 1
        self._stamp = 0
        self._shape: tuple[int, ...] = ()
        self.reset()

    def reset(self) -> None:
        """Forget the planes: none of them is matched. Their ids are not given again."""
        self._tracks: Tracks | None = None

    def track(
        self, labels: Labels, planes: Sequence[Plane], stamp: int, motion: Motion | None = None
    ) -> list[Plane]:
        """The planes of the next frame, of labels (H, W), with their `id` and `surface`.

        `stamp` is in nanoseconds, and not before that of the last frame. A frame of another size
        starts anew: nothing known is matched to it. `motion` takes points of the last frame to
        this one, where it is known; the planes tell the rest.
        """
        if labels.shape != self._shape:
            self.reset()
        elapsed = (stamp - self._stamp) * 1e-9 if stamp > self._stamp > 0 else NOMINAL
        self._stamp, self._shape = stamp, labels.shape
        seen = Tracks.of(planes, labels)
        known = self._tracks or Tracks.of([], labels)
        shared = known.shared(seen)
        # Planes that were in sight and have half of their pixels in common.
        sure = 2 * shared > np.maximum(known.size[:, None], seen.size)
        sure &= (known.unseen == 0)[:, None] & _near(known, seen)
        speed = np.repeat([np.radians(self.config.camera_turn), self.config.camera_speed], 3)
        prior = (min(max(elapsed, NOMINAL), PERSISTENCE) * speed) ** -2.0
        known = known.moved(*_camera_motion(known, seen, np.nonzero(sure), prior, motion))
        seen.id[:] = _assign(known, seen, shared)
        new = seen.id == 0
        seen.id[new] = self._next + np.arange(new.sum())
        self._next += int(new.sum())
        seen.surface[:] = self._surfaces(planes, seen, known)
        lost = ~np.isin(known.id, seen.id)
        known.unseen[:] += elapsed
        self._tracks = seen.joined(known.where(lost & (known.unseen <= self.config.track_time)))
        names = zip(planes, seen.id.tolist(), seen.surface.tolist(), strict=True)
        return [plane.named(id=i, surface=surface) for plane, i, surface in names]

    def _surfaces(self, planes: Sequence[Plane], seen: Tracks, known: Tracks) -> list[int]:
        """Ids of the surfaces that the planes lie on: the lowest that any part of them has had."""
        before = dict(zip(known.id.tolist(), known.surface.tolist(), strict=True))
        groups: dict[int, list[int]] = {}
        for n, plane in enumerate(planes):
            groups.setdefault(plane.surface, []).append(n)
        claims = []
        for members in groups.values():
            own = seen.id[members].tolist()
            claim = min(before.get(i, i) for i in own)
            # Of surfaces that come apart, the one with the plane that gave the id keeps it.
            pixels = sum(planes[n].count for n in members)
            claims.append((claim not in own, -pixels, members, (claim, min(own))))
        taken: set[int] = set()
        surfaces = [0] * len(planes)
        for _, _, members, wanted in sorted(claims):
            free = [i for i in wanted if i not in taken]
            surface = free[0] if free else self._next
            self._next += surface == self._next
            taken.add(surface)
            for n in members:
                surfaces[n] = surface
        return surfaces


def _near(known: Tracks, seen: Tracks) -> Mask:
    """(T, N) see `candidates`."""
    first, second = (known.plane[:, :3], known.plane[:, 3]), (seen.plane[:, :3], seen.centroid)
    return candidates(first, second, seen.range)


def _differences(
    known: Tracks, seen: Tracks, t: Indices, s: Indices
) -> tuple[Floats, Floats, Floats, Floats]:
    """What planes `s` (K,) seen differ by from known planes `t`, at the centroids of the former.

    As errors (K, 3) of the known planes, with covariances (K, 3, 3), tangents (K, 2, 3) of the
    known planes, and the points (K, 3) that were looked at.
    """
    normal, place = known.plane[t, :3], seen.centroid[s]
    axes = tangents(normal)
    offset = (normal * place).sum(axis=1) + known.plane[t, 3]
    point = place - offset[:, None] * normal
    local = to_errors(axes, point)
    gap = (local @ seen.plane[s][..., None])[..., 0]
    spread = congruent(local, known.covariance[t] + seen.covariance[s])
    width = np.minimum(known.width[t], seen.width[s])
    return gap, with_floor(spread, seen.range[s], width), axes, point


def _camera_motion(
    known: Tracks, seen: Tracks, pairs: tuple[Indices, ...], prior: Floats, stated: Motion | None
) -> Motion:
    """Motion of the known planes to those that are seen, of sure pairs of them.

    Gauss-Newton steps for the turn and the shift, weighted by the covariances of the pairs; those
    that fit badly (things that move by themselves) count less. Weights are relative to the median
    misfit, so that a wrong motion is corrected. Directions in which the planes leave the motion
    open are held by a prior, with the inverse variances `prior` (6,): the motion stated, or none.
    """
    t, s = pairs
    rotation, shift = stated or (np.eye(3), np.zeros(3))
    for _ in range(_MOTION_ROUNDS if len(t) else 0):
        gap, spread, axes, point = _differences(known.moved(rotation, shift), seen, t, s)
        design = by_motion(np.cross(axes[:, 0], axes[:, 1]), axes, point)
        value = mahalanobis(gap, spread)
        weight = 1 / (1 + value / (4 * max(float(np.median(value)), 1)))
        weighted = weight[:, None, None] * np.linalg.solve(spread, design)
        left = np.diag(prior) + np.einsum('kia,kib->ab', weighted, design)
        step = np.linalg.solve(left, -np.einsum('kia,ki->a', weighted, gap))
        twist = rotation_by(step[:3])
        rotation, shift = twist @ rotation, twist @ shift + step[3:]
        if step @ left @ step < _SETTLED:
            break
    return rotation, shift


def _assign(known: Tracks, seen: Tracks, shared: Indices) -> Indices:
    """(N,) id of the known plane that each plane is, 0 for none."""
    # Here, as it takes as long to import as a frame and is for sequences only.
    from scipy.optimize import linear_sum_assignment

    between = np.linalg.norm(known.centroid[:, None] - seen.centroid, axis=2)
    near = (shared > 0) | (between < np.add.outer(known.reach, seen.reach))
    t, s = np.nonzero(near & _near(known, seen))
    gap, spread, _, _ = _differences(known, seen, t, s)
    value = mahalanobis(gap, spread)
    fits = value < GATE
    t, s, value = t[fits], s[fits], value[fits]
    union = np.maximum(known.size[t] + seen.size[s] - shared[t, s], 1)
    # Little without overlap, or two bad pairs would be worth more than one that is sure.
    affinity = np.zeros(near.shape)
    affinity[t, s] = (shared[t, s] / union + _UNSEEN_OVERLAP) * np.exp(-value / 8)
    rows, columns = linear_sum_assignment(affinity, maximize=True)
    rows, columns = rows[affinity[rows, columns] > 0], columns[affinity[rows, columns] > 0]
    ids = np.zeros(len(seen.id), np.int64)
    ids[columns] = known.id[rows]
    return ids
