"""Size and place of regions on their planes, worked out when an output asks for them."""

from __future__ import annotations

from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.description.extents import areas_and_axes, rectangles
from rangeseg_ros.core.rotations import cross_products, quaternions
from rangeseg_ros.core.sensing.range_image import RangeImage


class Shape(NamedTuple):
    """Size and place of a region, see `Plane`."""

    area: float
    extents: NDArray[np.float64]
    centre: NDArray[np.float64]
    orientation: NDArray[np.float64]


class Shapes:
    """Shapes of the regions of an image, all worked out when the first is asked for.

    Parameters
    ----------
    labels : (H, W) uint16
        0...M.
    image : RangeImage
        (H, W).
    theta : (M + 1, 3) float64
        Planes, theta . ray = inverse range; zeros where there is none.
    """

    def __init__(
        self,
        labels: NDArray[np.uint16],
        image: RangeImage,
        theta: NDArray[np.float64],
    ) -> None:
        self._lock = Lock()
        self._source: tuple[NDArray[np.uint16], RangeImage] | None = labels, image
        self._theta = theta
        self._shapes: list[Shape] = []
        self._finite = np.zeros(0, np.bool_)

    def __getitem__(self, label: int) -> Shape:
        """Shape of a region that has one."""
        self._work_out()
        return self._shapes[label]

    def finite(self) -> NDArray[np.bool_]:
        """Which regions have one (M + 1,): steep planes may have pixels whose rays miss them."""
        self._work_out()
        return self._finite

    def _work_out(self) -> None:
        if self._source is None:
            return
        with self._lock:
            if self._source is not None:
                self._shapes, self._finite = _measure(*self._source, self._theta)
                # The image may be large, and planes are kept.
                self._source = None


class RegionShape:
    """Shape of one region, that of `Shapes` when read; a `Shape` in a pickle."""

    def __init__(self, shapes: Shapes, label: int) -> None:
        self._shapes, self._label = shapes, label

    def __getattr__(self, name: str) -> Any:
        return getattr(self._shapes[self._label], name)

    def __reduce__(self) -> tuple[type[Shape], Shape]:
        return Shape, self._shapes[self._label]


def _measure(
    labels: NDArray[np.uint16],
    image: RangeImage,
    theta: NDArray[np.float64],
) -> tuple[list[Shape], NDArray[np.bool_]]:
    """The shapes, and which of them are finite."""
    slope = np.linalg.norm(theta, axis=1)
    distance = np.divide(1, slope, out=np.zeros_like(slope), where=slope > 0)
    normal = -theta * distance[:, None]
    area, major = areas_and_axes(labels, image, theta, _tangents(normal))
    axes = np.stack([major, cross_products(normal, major)], axis=1)
    limits = rectangles(labels, image, theta, axes)
    finite = np.isfinite(limits).all(axis=(1, 2)) & np.isfinite(area) & (slope > 0)
    limits[~finite], area[~finite] = 0, 0
    extents = limits[..., 1] - limits[..., 0]
    centre = np.einsum('ka,kai->ki', limits.mean(axis=2), axes) - distance[:, None] * normal
    centre += image.place
    frames = np.stack([axes[:, 0], axes[:, 1], normal], axis=2)
    frames[slope == 0] = np.eye(3)
    return list(map(Shape, area.tolist(), extents, centre, quaternions(frames))), finite


def _tangents(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two unit vectors across each normal, (N, 2, 3)."""
    across = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = cross_products(normal, across)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-300)
    return np.stack([first, cross_products(normal, first)], axis=1)
