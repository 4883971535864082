"""Camera intrinsics in ROS camera-calibration YAML files."""

from __future__ import annotations

from pathlib import Path

import yaml

from rangeseg_ros.core.sensing.camera import Camera, CameraError
from rangeseg_ros.io.files import replacing


def read_camera(path: Path) -> Camera:
    """Read the intrinsics of a ROS camera-calibration YAML file.

    Raises
    ------
    CameraError
        A missing or unreadable file, or one without valid intrinsics.
    """
    try:
        calibration = yaml.safe_load(path.read_text())
    except OSError as error:
        raise CameraError(f'{path}: {error.strerror}') from None
    except (UnicodeDecodeError, yaml.YAMLError):
        raise CameraError(f'{path}: not a YAML file') from None
    if not isinstance(calibration, dict):
        raise CameraError(f'{path}: not a camera calibration')
    try:
        return Camera.from_calibration(calibration)
    except ValueError as error:
        raise CameraError(f'{path}: {error}') from None


def write_camera(path: Path, camera: Camera, name: str = 'depth') -> None:
    """Write a ROS camera-calibration YAML file."""
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    p = [camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    calibration = {
        'image_width': camera.width,
        'image_height': camera.height,
        'camera_name': name,
        'camera_matrix': {'rows': 3, 'cols': 3, 'data': k},
        'distortion_model': 'plumb_bob',
        'distortion_coefficients': {'rows': 1, 'cols': 5, 'data': [0.0] * 5},
        'rectification_matrix': {
            'rows': 3,
            'cols': 3,
            'data': [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        },
        'projection_matrix': {'rows': 3, 'cols': 4, 'data': p},
    }
    with replacing(path) as partial:
        partial.write_text(yaml.safe_dump(calibration, sort_keys=False, default_flow_style=None))
