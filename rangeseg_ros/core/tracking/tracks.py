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

    `plane` (N, 4) are normals and distances. `footprint` and `owner` list the samples of the label
    image in which the planes were last seen and whose they were, 0...N-1; `unseen` is how many
    seconds have passed since then. `width` (N,) and `reach` are half the width and half the
    diagonal of the rectangle around each plane, metres.
    """

    id: NDArray[np.int64]
    surface: NDArray[np.int64]
    plane: NDArray[np.float64]
    covariance: NDArray[np.float64]
    centroid: NDArray[np.float64]
    width: NDArray[np.float64]
    reach: NDArray[np.float64]
    unseen: NDArray[np.float64]
    footprint: NDArray[np.intp]
    owner: NDArray[np.intp]

    @classmethod
    def of(cls, planes: Sequence[Plane], samples: NDArray[np.intp]) -> Tracks:
        """Planes seen now, without ids (0)."""
        footprint = np.flatnonzero(samples)
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
            footprint,
            samples[footprint] - 1,
        )

    @property
    def normal(self) -> NDArray[np.float64]:
        """(N, 3)."""
        return self.plane[:, :3]

    @cached_property
    def size(self) -> NDArray[np.intp]:
        """(N,) number of samples of each plane."""
        return np.bincount(self.owner, minlength=len(self.id))

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
