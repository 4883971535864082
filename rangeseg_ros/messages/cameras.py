"""Cameras of messages: sensor_msgs/CameraInfo in and out."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.core.sensing.camera import Camera, CameraError, CameraWarning, positive_integer
from rangeseg_ros.messages.make import CAMERA_INFO, Make


def raw_by_name(topic: str) -> bool | None:
    """Whether images are raw (True) or rectified (False) by their topic; None: it does not say.

    The names are those of image_proc and the drivers: image_raw; image_rect, image_rect_raw.
    """
    name = re.sub(r'/compressed(Depth)?$', '', topic).rpartition('/')[2].lower()
    if 'rect' in name:
        return False
    return True if 'raw' in name else None


def camera_from_message(info: Any, raw: bool | None = None) -> Camera:
    """Camera of a sensor_msgs/CameraInfo; the same object, with its rays, while nothing changes.

    `info` is of rclpy, rosbags or ROS 1; `raw` and errors are those of `camera_from_matrices`.
    """
    # ROS 1 has capitals.
    k, p, d = (
        tuple(map(float, getattr(info, name if hasattr(info, name) else name.upper())))
        for name in 'kpd'
    )
    binning = info.binning_x, info.binning_y
    roi = info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height
    return _camera(info.width, info.height, k, p, binning, roi, info.distortion_model, d, raw)


@lru_cache(maxsize=1)
def _camera(*fields: Any) -> Camera:
    return camera_from_matrices(*fields)


def camera_from_matrices(
    width: int,
    height: int,
    k: ArrayLike,
    p: ArrayLike | None = None,
    binning: Sequence[int] = (0, 0),
    roi: Sequence[int] = (0, 0, 0, 0),
    distortion_model: str = '',
    d: Sequence[float] = (),
    raw: bool | None = None,
) -> Camera:
    """Camera of an image described by a CameraInfo message, whose fields the parameters are.

    More than seven parameters, as the message has as many that describe a camera.

    Rectified images are described by P, raw ones by K and the lens. A lens that distorts,
    beside the P of rectified images, is left out with a `CameraWarning`.

    Parameters
    ----------
    width, height : int
        Size of the full-resolution image, before binning and ROI.
    k, p : array_like
        The 3x3 and 3x4 matrices, nested or flat. Zeros stand for a missing P.
    binning : (int, int)
        Binning in x and y; 0 means 1.
    roi : (int, int, int, int)
        x offset, y offset, width, height in full-resolution pixels; width or height 0 means
        the full image.
    distortion_model, d
        The lens, for raw images.
    raw : bool, optional
        Whether the image is raw; when it is not known, it is where P is missing.

    Raises
    ------
    CameraError
        As `Camera`; matrices of a wrong size or form; a rectified image without P of
        a lens that distorts.
    """
    width, height = positive_integer('width', width), positive_integer('height', height)
    d = _numbers('lens distortion D', d).tolist()
    matrix, raw = _matrix_in_use(k, p, any(d), raw)
    bin_x, bin_y = max(int(binning[0]), 1), max(int(binning[1]), 1)
    x0, y0, roi_width, roi_height = (int(v) for v in roi)
    if roi_width == 0 or roi_height == 0:
        x0, y0, roi_width, roi_height = 0, 0, width, height
    # A binned pixel's centre lies at the mean of the centres it collects.
    return Camera(
        roi_width // bin_x,
        roi_height // bin_y,
        float(matrix[0, 0]) / bin_x,
        float(matrix[1, 1]) / bin_y,
        (float(matrix[0, 2]) - x0 + 0.5) / bin_x - 0.5,
        (float(matrix[1, 2]) - y0 + 0.5) / bin_y - 0.5,
        float(matrix[0, 1]) / bin_x,
        distortion_model=distortion_model if raw else '',
        d=tuple(d) if raw else (),
    )


def _matrix_in_use(
    k: ArrayLike, p: ArrayLike | None, distorts: bool, raw: bool | None
) -> tuple[Floats, bool]:
    """P of rectified images or K of raw ones, and whether the image is raw."""
    matrix = _matrix('camera matrix K', k, 3)
    projection = None if p is None or raw else _matrix('projection matrix P', p, 4)
    if projection is None or not projection.any():
        if raw is False and distorts:
            raise CameraError('the image is rectified by its name, but its calibration has no P')
        return matrix, raw is not False
    if distorts:
        left_out = 'the image is taken as rectified: the lens distortion D beside P is left out'
        warnings.warn(left_out, CameraWarning, stacklevel=3)
    return projection, False


def _matrix(name: str, values: ArrayLike, columns: int) -> Floats:
    """Matrix (3, columns) of a calibration, which has zeros below its diagonal."""
    matrix = _numbers(name, values)
    if matrix.size != 3 * columns:
        raise CameraError(f'{name} must have {3 * columns} values, not {matrix.size}')
    matrix = matrix.reshape(3, columns)
    if matrix[1, 0] or matrix[2, 0] or matrix[2, 1]:
        raise CameraError(f'{name} must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]], row by row')
    return matrix


def _numbers(name: str, values: ArrayLike) -> Floats:
    try:
        return np.asarray(values, dtype=float).ravel()
    except (TypeError, ValueError, OverflowError):
        raise CameraError(f'{name} must be numbers') from None


def camera_info_message(make: Make, header: Any, camera: Camera) -> Any:
    """sensor_msgs/CameraInfo of rectified images (pinhole camera), or of raw ones."""
    p = np.zeros((3, 4))
    if camera.pinhole:
        p[:, :3] = camera.matrix
    roi = {'x_offset': 0, 'y_offset': 0, 'height': 0, 'width': 0, 'do_rectify': False}
    return make(
        CAMERA_INFO,
        header=header,
        height=camera.height,
        width=camera.width,
        distortion_model=camera.distortion_model or 'plumb_bob',
        d=np.array(camera.d or (0.0,) * 5),
        k=camera.matrix.ravel(),
        r=np.eye(3).ravel(),
        p=p.ravel(),
        binning_x=0,
        binning_y=0,
        roi=make('sensor_msgs/msg/RegionOfInterest', **roi),
    )
