"""Cameras from calibrations: the fields of CameraInfo messages, and the files of ROS."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.sensing.camera import Camera, CameraError, CameraWarning, positive_integer


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
    matrix = _matrix('camera matrix K', k, 3)
    projection = None if p is None or raw else _matrix('projection matrix P', p, 4)
    if projection is not None and not projection.any():
        projection = None
    d = _numbers('lens distortion D', d).tolist()
    if projection is not None:
        matrix = projection[:, :3]
        if any(d):
            warnings.warn(
                'the image is taken as rectified: the lens distortion D beside P is left out',
                CameraWarning,
                stacklevel=2,
            )
    elif raw is False and any(d):
        raise CameraError('the image is rectified by its name, but its calibration has no P')
    lens = (distortion_model, d) if projection is None and raw is not False else ('', ())
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
        distortion_model=lens[0],
        d=tuple(lens[1]),
    )


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
        raise CameraError('malformed camera calibration: no mapping')
    width, height = _entry(calibration, 'image_width'), _entry(calibration, 'image_height')
    k = _data(calibration, 'camera_matrix')
    if k is None:
        raise CameraError("camera calibration lacks 'camera_matrix'")
    p = _data(calibration, 'projection_matrix')
    d = _data(calibration, 'distortion_coefficients')
    model = calibration.get('distortion_model') or ''
    if not isinstance(model, str):
        raise CameraError(f'malformed camera calibration: distortion_model {model!r}')
    try:
        return camera_from_matrices(
            width, height, k, p, distortion_model=model, d=() if d is None else d, raw=raw
        )
    except (TypeError, OverflowError) as error:
        raise CameraError(f'malformed camera calibration: {error}') from None


def _matrix(name: str, values: ArrayLike, columns: int) -> NDArray[np.float64]:
    """Matrix (3, columns) of a calibration, which has zeros below its diagonal."""
    matrix = _numbers(name, values)
    if matrix.size != 3 * columns:
        raise CameraError(f'{name} must have {3 * columns} values, not {matrix.size}')
    matrix = matrix.reshape(3, columns)
    if matrix[1, 0] or matrix[2, 0] or matrix[2, 1]:
        raise CameraError(f'{name} must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]], row by row')
    return matrix


def _numbers(name: str, values: ArrayLike) -> NDArray[np.float64]:
    try:
        return np.asarray(values, dtype=float).ravel()
    except (TypeError, ValueError, OverflowError):
        raise CameraError(f'{name} must be numbers') from None


def _entry(calibration: Mapping[str, Any], key: str) -> Any:
    if key not in calibration:
        raise CameraError(f'camera calibration lacks {key!r}')
    return calibration[key]


def _data(calibration: Mapping[str, Any], key: str) -> Any:
    """Values of a matrix of a calibration; None when it is not there."""
    entry = calibration.get(key)
    if entry is None:
        return None
    if not isinstance(entry, Mapping):
        raise CameraError(f'malformed camera calibration: {key} has no data')
    return _entry(entry, 'data')
