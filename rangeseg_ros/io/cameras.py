"""Camera intrinsics in files: ROS camera calibrations and the JSON of Open3D."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rangeseg_ros.core.sensing.calibrations import camera_from_calibration
from rangeseg_ros.core.sensing.camera import Camera, CameraError
from rangeseg_ros.io.files import replacing
from rangeseg_ros.io.yaml_files import YamlError, read_yaml


def read_camera(path: Path, raw: bool = False) -> Camera:
    """Read the intrinsics of a ROS camera-calibration YAML file, or of the JSON of Open3D.

    Parameters
    ----------
    path : Path
    raw : bool
        The images are raw though there is a P for rectified ones.

    Raises
    ------
    CameraError
        A missing or unreadable file, or one without valid intrinsics.
    """
    try:
        calibration = read_yaml(path)
    except YamlError as error:
        raise CameraError(str(error)) from None
    if not isinstance(calibration, dict):
        raise CameraError(f'{path}: not a camera calibration')
    # JSON is YAML. Open3D writes K by columns, with the poses of cameras inside `intrinsic`.
    inner = calibration.get('intrinsic', calibration)
    if isinstance(inner, dict) and 'intrinsic_matrix' in inner:
        try:
            k = np.array(inner['intrinsic_matrix'], float).reshape(3, 3).T
            return Camera(inner['width'], inner['height'], k[0, 0], k[1, 1], k[0, 2], k[1, 2])
        except (KeyError, TypeError, ValueError) as error:
            raise CameraError(f'{path}: not intrinsics of Open3D: {error}') from None
    try:
        return camera_from_calibration(calibration, raw or None)
    except ValueError as error:
        raise CameraError(f'{path}: {error}') from None


def write_camera(path: Path, camera: Camera, name: str = 'depth') -> None:
    """Write a ROS camera-calibration YAML file: without P unless the camera is a pinhole."""
    d = list(camera.d or (0.0,) * 5)
    calibration: dict[str, Any] = {
        'image_width': camera.width,
        'image_height': camera.height,
        'camera_name': name,
        'camera_matrix': {'rows': 3, 'cols': 3, 'data': camera.matrix.ravel().tolist()},
        'distortion_model': camera.distortion_model or 'plumb_bob',
        'distortion_coefficients': {'rows': 1, 'cols': len(d), 'data': d},
        'rectification_matrix': {
            'rows': 3,
            'cols': 3,
            'data': [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        },
    }
    if camera.pinhole:
        p = np.pad(camera.matrix, ((0, 0), (0, 1))).ravel().tolist()
        calibration['projection_matrix'] = {'rows': 3, 'cols': 4, 'data': p}
    with replacing(path) as partial:
        partial.write_text(yaml.safe_dump(calibration, sort_keys=False, default_flow_style=None))
