"""Camera intrinsics in files: ROS camera calibrations and the JSON of Open3D."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rangeseg_ros.core.sensing.camera import Camera, CameraError
from rangeseg_ros.io.files import replacing
from rangeseg_ros.io.yaml_files import read_yaml
from rangeseg_ros.messages.cameras import camera_from_matrices


def read_camera(path: Path, raw: bool = False) -> Camera:
    """Read the intrinsics of a ROS camera-calibration YAML file, or of the JSON of Open3D.

    `raw`: the images are raw though there is a P for rectified ones. FileError or CameraError: one
    that cannot be read, or without valid intrinsics.
    """
    calibration = read_yaml(path)
    # JSON is YAML. Open3D writes K by columns, with the poses of cameras inside `intrinsic`.
    inner = calibration.get('intrinsic', calibration) if isinstance(calibration, dict) else None
    if isinstance(inner, dict) and 'intrinsic_matrix' in inner:
        try:
            k = np.array(inner['intrinsic_matrix'], float).reshape(3, 3).T
            return Camera(inner['width'], inner['height'], k[0, 0], k[1, 1], k[0, 2], k[1, 2])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise CameraError(f'{path}: not intrinsics of Open3D: {error}') from None
    try:
        return camera_from_calibration(calibration, raw or None)
    except ValueError as error:
        raise CameraError(f'{path}: {error}') from None


def camera_from_calibration(calibration: Mapping[str, Any], raw: bool | None = None) -> Camera:
    """Camera from the parsed content of a ROS camera-calibration YAML file.

    Parameters
    ----------
    calibration : mapping
    raw : bool, optional
        As for `camera_from_matrices`.

    Raises
    ------
    CameraError
        A missing or malformed key, named in the message.
    """
    if not isinstance(calibration, Mapping):
        raise CameraError('not a camera calibration, or a malformed one: no mapping')
    for key in ('image_width', 'image_height', 'camera_matrix'):
        if calibration.get(key) is None:
            raise CameraError(f'camera calibration lacks {key!r}')
    width, height = calibration['image_width'], calibration['image_height']
    matrices = ('camera_matrix', 'projection_matrix', 'distortion_coefficients')
    k, p, d = (_data(calibration, key) for key in matrices)
    model = calibration.get('distortion_model') or ''
    if not isinstance(model, str):
        raise CameraError(f'malformed camera calibration: distortion_model {model!r}')
    try:
        return camera_from_matrices(
            width, height, k, p, distortion_model=model, d=() if d is None else d, raw=raw
        )
    except (TypeError, OverflowError) as error:
        raise CameraError(f'malformed camera calibration: {error}') from None


def _data(calibration: Mapping[str, Any], key: str) -> Any:
    """Values of a matrix of a calibration; None when it is not there."""
    entry = calibration.get(key)
    if entry is None:
        return None
    if not isinstance(entry, Mapping) or 'data' not in entry:
        raise CameraError(f'malformed camera calibration: {key} has no data')
    return entry['data']


def write_camera(path: Path, camera: Camera) -> None:
    """Write a ROS camera-calibration YAML file: without P unless the camera is a pinhole."""
    d = list(camera.d or (0.0,) * 5)
    calibration: dict[str, Any] = {
        'image_width': camera.width,
        'image_height': camera.height,
        'camera_name': 'depth',
        'camera_matrix': {'rows': 3, 'cols': 3, 'data': camera.matrix.ravel().tolist()},
        'distortion_model': camera.distortion_model or 'plumb_bob',
        'distortion_coefficients': {'rows': 1, 'cols': len(d), 'data': d},
        'rectification_matrix': {'rows': 3, 'cols': 3, 'data': np.eye(3).ravel().tolist()},
    }
    if camera.pinhole:
        p = np.pad(camera.matrix, ((0, 0), (0, 1))).ravel().tolist()
        calibration['projection_matrix'] = {'rows': 3, 'cols': 4, 'data': p}
    with replacing(path) as partial:
        partial.write_text(yaml.safe_dump(calibration, sort_keys=False, default_flow_style=None))
