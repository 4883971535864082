"""Pinhole intrinsics and the rays of the pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


class CameraError(ValueError):
    """Intrinsics that cannot belong to a pinhole camera."""


@dataclass(frozen=True)
class Camera:
    """A rectified pinhole camera in the ROS optical frame (REP 103): x right, y down, z forward.

    Parameters
    ----------
    width, height : int
        Size of the image, pixels.
    fx, fy : float
        Focal lengths, pixels.
    cx, cy : float
        Principal point, pixels; the centre of the first pixel is (0, 0).

    Raises
    ------
    CameraError
        Empty image, non-finite intrinsics, or a focal length that is not positive.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise CameraError(f'image size must be positive, not {self.width}x{self.height}')
        for name in ('fx', 'fy', 'cx', 'cy'):
            value = getattr(self, name)
            if not np.isfinite(value):
                raise CameraError(f'{name} must be finite, not {value}')
        for name in ('fx', 'fy'):
            if getattr(self, name) <= 0:
                raise CameraError(
                    f'focal length {name} must be positive, not {getattr(self, name)}'
                )

    @classmethod
    def from_matrices(
        cls,
        width: int,
        height: int,
        k: ArrayLike,
        p: ArrayLike | None = None,
        binning: Sequence[int] = (0, 0),
        roi: Sequence[int] = (0, 0, 0, 0),
    ) -> Camera:
        """Camera of an image described by a CameraInfo message.

        Parameters
        ----------
        width, height : int
            Size of the full-resolution image, before binning and ROI.
        k, p : array_like
            The 3x3 and 3x4 matrices, nested or flat. `p` is used when the image is rectified
            (p[0, 0] > 0), `k` otherwise.
        binning : (int, int)
            Binning in x and y; 0 means 1.
        roi : (int, int, int, int)
            x offset, y offset, width, height in full-resolution pixels; width or height 0 means
            the full image.

        Raises
        ------
        CameraError
            As the constructor, and matrices of a wrong size.
        """
        matrix = np.asarray(k, dtype=float).ravel()
        if matrix.size != 9:
            raise CameraError(f'camera matrix K must have 9 values, not {matrix.size}')
        if p is not None:
            projection = np.asarray(p, dtype=float).ravel()
            if projection.size != 12:
                raise CameraError(
                    f'projection matrix P must have 12 values, not {projection.size}'
                )
            if projection[0] > 0:
                matrix = projection.reshape(3, 4)[:, :3].ravel()
        bin_x, bin_y = max(int(binning[0]), 1), max(int(binning[1]), 1)
        x0, y0, roi_width, roi_height = (int(v) for v in roi)
        if roi_width == 0 or roi_height == 0:
            x0, y0, roi_width, roi_height = 0, 0, width, height
        # A binned pixel's centre lies at the mean of the centres it collects.
        return cls(
            roi_width // bin_x,
            roi_height // bin_y,
            float(matrix[0]) / bin_x,
            float(matrix[4]) / bin_y,
            (float(matrix[2]) - x0 + 0.5) / bin_x - 0.5,
            (float(matrix[5]) - y0 + 0.5) / bin_y - 0.5,
        )

    @classmethod
    def from_calibration(cls, calibration: Mapping[str, Any]) -> Camera:
        """Camera from the parsed content of a ROS camera-calibration YAML file.

        Raises
        ------
        CameraError
            A missing or malformed key, named in the message.
        """
        try:
            width, height = int(calibration['image_width']), int(calibration['image_height'])
            k = calibration['camera_matrix']['data']
            p = calibration.get('projection_matrix', {}).get('data')
            return cls.from_matrices(width, height, k, p)
        except KeyError as error:
            raise CameraError(f'camera calibration lacks {error}') from None
        except (TypeError, AttributeError) as error:
            raise CameraError(f'malformed camera calibration: {error}') from None

    def __reduce__(self) -> tuple[type[Camera], tuple[Any, ...]]:
        # Without the rays: they are large, and would come back writeable, to compiled code a type
        # of its own.
        return Camera, astuple(self)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of an image of this camera: (height, width)."""
        return self.height, self.width

    @cached_property
    def rays(self) -> NDArray[np.float32]:
        """Directions of the pixels scaled to z = 1, (H, W, 3), so that point = depth * ray."""
        rays = np.ones((self.height, self.width, 3), np.float32)
        rays[..., 0] = (np.arange(self.width) - self.cx) / self.fx
        rays[..., 1] = ((np.arange(self.height) - self.cy) / self.fy)[:, None]
        rays.setflags(write=False)
        return rays
