"""Cameras of messages: sensor_msgs/CameraInfo in and out."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any

import numpy as np

from rangeseg_ros.core.sensing.calibrations import camera_from_matrices
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.messages.make import Make


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

    Parameters
    ----------
    info : sensor_msgs/CameraInfo
        Of rclpy, rosbags or ROS 1.
    raw : bool, optional
        Whether the images are raw, see `camera_from_matrices`.

    Raises
    ------
    CameraError
        Intrinsics that no camera has, or a lens of an unknown model.
    """
    # ROS 1 has capitals.
    k, p, d = (
        tuple(map(float, getattr(info, name if hasattr(info, name) else name.upper())))
        for name in 'kpd'
    )
    roi = info.roi
    return _camera(
        info.width,
        info.height,
        k,
        p,
        (info.binning_x, info.binning_y),
        (roi.x_offset, roi.y_offset, roi.width, roi.height),
        info.distortion_model,
        d,
        raw,
    )


@lru_cache(maxsize=1)
def _camera(*fields: Any) -> Camera:
    return camera_from_matrices(*fields)


def camera_info_message(make: Make, header: Any, camera: Camera) -> Any:
    """sensor_msgs/CameraInfo of rectified images (pinhole camera), or of raw ones."""
    p = np.zeros((3, 4))
    if camera.pinhole:
        p[:, :3] = camera.matrix
    roi = {'x_offset': 0, 'y_offset': 0, 'height': 0, 'width': 0, 'do_rectify': False}
    return make(
        'sensor_msgs/msg/CameraInfo',
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
