"""The camera of an organised cloud, where its points show one."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.camera import Camera, CameraError

# Rounding errors of a coordinate: those of the intrinsics, of the depth, of what takes one to the
# other, and of their quotient.
_ROUNDINGS = 8
_PRECISION = _ROUNDINGS * 2.0**-24
# To which intrinsics are rounded, pixels: frames of a sensor share a camera. A power of two, as
# numbers of few decimals are never halfway between two of these.
_STEP = 2.0**-10
# Largest error of the camera, pixels: less than any sensor's.
_CLOSE = 0.01
# Rows and columns that tell the camera, about.
_TELLING = 64


def camera_of(points: NDArray[np.floating], valid: NDArray[np.bool_]) -> Camera | None:
    """The pinhole camera that points lie on the rays of.

    x / z is linear in the column then, and y / z in the row, to the precision of float32. Lenses
    and scanners bend the lines by far more.

    Parameters
    ----------
    points : (H, W, 3) float
        In an optical frame, metres.
    valid : (H, W) bool
        Which of them were measured.

    Returns
    -------
    Camera or None
        None where points lie on no such rays, or fill less than half of the rows or columns:
        rays of the others would be guessed.
    """
    height, width = valid.shape
    # Odd steps, as holes come in every second row or column.
    down, across = max(height // _TELLING, 1) | 1, max(width // _TELLING, 1) | 1
    v, u = np.nonzero(valid[::down, ::across])
    x, y, z = points[::down, ::across][v, u].astype(np.float64).T
    if not (z > 0).all():
        return None
    columns, rows = _line(u * across, x / z, width), _line(v * down, y / z, height)
    if columns is None or rows is None:
        return None
    camera = _camera(width, height, columns[0], rows[0], columns[1], rows[1])
    if camera is None:
        return None
    z = points[..., 2]
    with np.errstate(invalid='ignore', over='ignore'):
        for axis, focal in ((0, camera.fx), (1, camera.fy)):
            error = np.abs(points[..., axis] - z * camera.rays[..., axis])
            if (valid & ~(error <= _CLOSE / focal * z)).any():
                return None
    return camera


def _line(
    place: NDArray[np.intp], slope: NDArray[np.float64], size: int
) -> tuple[float, float] | None:
    """Focal length and centre, pixels, of rays of these slopes (N,) in columns or rows."""
    if not len(place) or 2 * (place.max() - place.min()) <= size - 1:
        return None
    away = place - place.mean()
    step = (away @ slope) / (away @ away)
    error = np.abs(slope - slope.mean() - step * away)
    if step <= 0 or error.max() > _PRECISION * np.abs(slope).max():
        return None
    return tuple(round(n / _STEP) * _STEP for n in (1 / step, place.mean() - slope.mean() / step))


@lru_cache(maxsize=4)
def _camera(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Camera | None:
    """One for all frames, as its rays are worked out once."""
    try:
        return Camera(width, height, fx, fy, cx, cy)
    except CameraError:
        return None
