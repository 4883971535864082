"""Planes of successive frames side by side, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.tracking.plane_errors import (
    NARROWEST,
    SURE_TURN,
    candidates,
    congruent,
    moved_plane,
    tangents,
    to_errors,
    with_floor,
)

# Rows or columns, whichever are fewer, at which overlap is looked at: a plane of the least size
# has about eight samples in a 640 x 480 image.
_SAMPLES = 60


@dataclass(frozen=True, eq=False)
class Tracks:
    """N planes in the frame of the camera.

    `plane` (N, 4) are normals and distances. `mask` (N, S) tells in which samples of the label
    image they were last seen; `unseen` is how many seconds have passed since then. `width` (N,)
    and `reach` are half the width and half the diagonal of the rectangle around each plane,
    metres.
    """

    id: NDArray[np.int64]
    surface: NDArray[np.int64]
    plane: NDArray[np.float64]
    covariance: NDArray[np.float64]
    centroid: NDArray[np.float64]
    width: NDArray[np.float64]
    reach: NDArray[np.float64]
    unseen: NDArray[np.float64]
    mask: NDArray[np.float32]

    @classmethod
    def of(cls, planes: Sequence[Plane], labels: NDArray[np.uint16]) -> Tracks:
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
            (coarse == own[:, None]).astype(np.float32),
        )

    @property
    def normal(self) -> NDArray[np.float64]:
        """(N, 3)."""
        return self.plane[:, :3]

    @cached_property
    def size(self) -> NDArray[np.float32]:
        """(N,) number of samples of each plane."""
        return self.mask.sum(axis=1)

    @cached_property
    def range(self) -> NDArray[np.float64]:
        """(N,) distances of the centroids from the camera, metres."""
        return np.asarray(np.linalg.norm(self.centroid, axis=1))

    def moved(self, rotation: NDArray[np.float64], shift: NDArray[np.float64]) -> Tracks:
        """The planes in a frame in which x is at rotation x + shift."""
        jacobian = moved_plane(rotation, shift)
        return replace(
            self,
            plane=self.plane @ jacobian.T,
            covariance=congruent(jacobian, self.covariance),
            centroid=self.centroid @ rotation.T + shift,
        )

    def where(self, chosen: NDArray[np.bool_]) -> Tracks:
        """Some of the planes."""
        return Tracks(*(getattr(self, f.name)[chosen] for f in fields(self)))

    def joined(self, others: Tracks) -> Tracks:
        """These planes followed by others."""
        pairs = ((getattr(self, f.name), getattr(others, f.name)) for f in fields(self))
        return Tracks(*map(np.concatenate, pairs))


def near_planes(known: Tracks, seen: Tracks, turn: float = SURE_TURN) -> NDArray[np.bool_]:
    """(T, N) see `candidates`."""
    first, second = (known.normal, known.plane[:, 3]), (seen.normal, seen.centroid)
    return candidates(first, second, seen.range, turn)


def differences(
    known: Tracks, seen: Tracks, t: NDArray[np.intp], s: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """What planes `s` (K,) seen differ by from known planes `t`, at the centroids of the former.

    Returns
    -------
    gap : (K, 3) float64
        As errors of the known planes.
    spread : (K, 3, 3) float64
        Covariances.
    axes : (K, 2, 3) float64
        Tangents of the known planes.
    point : (K, 3) float64
        Where they were looked at.
    """
    normal, place = known.normal[t], seen.centroid[s]
    axes = tangents(normal)
    offset = (normal * place).sum(axis=1) + known.plane[t, 3]
    point = place - offset[:, None] * normal
    local = to_errors(axes, point)
    gap = (local @ seen.plane[s][..., None])[..., 0]
    spread = congruent(local, known.covariance[t] + seen.covariance[s])
    width = np.minimum(known.width[t], seen.width[s])
    return gap, with_floor(spread, seen.range[s], width), axes, point
