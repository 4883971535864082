"""Camera intrinsics and the rays of the pixels."""

from __future__ import annotations

import math
import operator
import warnings
from dataclasses import astuple, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rangeseg_ros.core.arrays import Floats, Singles
from rangeseg_ros.core.rotations import rotation_matrix
from rangeseg_ros.core.sensing.lens import checked_lens, undistort

# Slope of a ray, 0.06 degrees from across the optical axis: no lens has such pixels, and the
# squares of their moments leave the range of the solvers.
_STEEPEST = 1000.0
_UNIT = 1e-6  # by which the square of a unit quaternion may be off: decimals of files
OPTICAL = (0.0, 0.0, 0.0, 1.0)  # the turn of a camera in its own optical frame: none


class CameraWarning(UserWarning):
    """A part of a calibration is left out, or of which a part of the image is left out."""


class CameraError(ValueError):
    """Intrinsics that no camera has, or of which something is not known."""


@dataclass(frozen=True)
class Camera:
    """A camera, by default in the ROS optical frame (REP 103): x right, y down, z forward.

    Parameters
    ----------
    width, height : int
        Size of the image, pixels.
    fx, fy : float
        Focal lengths, pixels.
    cx, cy : float
        Principal point, pixels; the centre of the first pixel is (0, 0).
    skew : float
        Shift of the columns per focal length downwards, pixels: K[0, 1].
    distortion_model : str
        Of the lens of raw images, see `lens.MODELS`; empty for rectified ones.
    d : tuple of float
        Coefficients of the model, as in CameraInfo.
    turn : tuple of 4 float
        Frame of the rays from the optical one, a unit quaternion x, y, z, w.
    place : tuple of 3 float
        Of the camera in the frame of its points, whose axes are those of the rays, metres.

    Raises
    ------
    CameraError
        Empty image, non-finite intrinsics, a focal length that is not positive, pixels that look
        across the optical axis, an unknown lens, a turn of another length, or no place.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    skew: float = 0.0
    distortion_model: str = ''
    d: tuple[float, ...] = ()
    turn: tuple[float, ...] = OPTICAL
    place: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        given = vars(self)
        values: dict[str, Any] = {}
        values |= {name: positive_integer(name, given[name]) for name in ('width', 'height')}
        values |= {name: _finite(name, given[name]) for name in ('fx', 'fy', 'cx', 'cy', 'skew')}
        for name in ('turn', 'place'):
            values[name] = tuple(_finite(name, part) for part in np.atleast_1d(given[name]))
        try:
            lens = checked_lens(self.distortion_model, self.d)
        except (TypeError, ValueError, AttributeError, OverflowError) as error:
            raise CameraError(str(error)) from None
        values['distortion_model'], values['d'] = lens
        vars(self).update(values)
        if len(self.turn) != 4 or abs(sum(q * q for q in self.turn) - 1) > _UNIT:
            raise CameraError(f'turn must be a unit quaternion x, y, z, w, not {self.turn!r}')
        if len(self.place) != 3:
            raise CameraError(f'place must be x, y, z, not {self.place!r}')
        for name in ('fx', 'fy'):
            if values[name] <= 0:
                raise CameraError(f'focal length {name} must be positive, not {values[name]}')
        self._check_rays()

    @classmethod
    def from_fov(cls, width: int, height: int, degrees: float) -> Camera:
        """A pinhole camera with square pixels and the principal point in the middle.

        Parameters
        ----------
        width, height : int
            Size of the image, pixels.
        degrees : float
            Horizontal field of view, from 0 to 180.

        Raises
        ------
        CameraError
            An empty image, or a field of view that no pinhole camera has.
        """
        if not 0 < _finite('field of view', degrees) < 180:
            raise CameraError(f'field of view must be between 0 and 180 degrees, not {degrees}')
        focal = _finite('width', width) / (2 * math.tan(math.radians(degrees) / 2))
        return cls(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    def _check_rays(self) -> None:
        # Of a grid over the image.
        across, down = (np.linspace(0, size - 1, 33) for size in (self.width, self.height))
        shown = np.isfinite(self.rays_at(*np.meshgrid(across, down))[..., 0])
        if not self.distortion_model and not shown.all():
            raise CameraError(
                f'focal lengths {self.fx:g}, {self.fy:g} and principal point {self.cx:g}, '
                f'{self.cy:g} do not fit {self.width}x{self.height} pixels'
            )
        if shown.sum() < 3:  # that a plane could be seen in
            raise CameraError('lens distortion D fits no lens: hardly any pixel has a ray')
        if not shown.all() and self.distortion_model != 'equidistant':
            warnings.warn(
                f'lens distortion D folds the image: {1 - shown.mean():.0%} of it is left out',
                CameraWarning,
                stacklevel=4,
            )

    def __reduce__(self) -> tuple[type[Camera], tuple[Any, ...]]:
        # Without the large rays, which would come back writeable: to compiled code another type.
        return Camera, astuple(self)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of an image of this camera: (height, width)."""
        return self.height, self.width

    @property
    def pinhole(self) -> bool:
        """Whether rays are evenly spaced: neither skew nor a lens that distorts."""
        return not self.distortion_model and self.skew == 0

    @cached_property
    def axes(self) -> Floats:
        """(3, 3) what is right, down and forward for the camera, as columns."""
        return rotation_matrix(self.turn)

    @property
    def matrix(self) -> Floats:
        """The 3x3 camera matrix K."""
        return np.array([[self.fx, self.skew, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    @cached_property
    def rays(self) -> Singles:
        """Directions of the pixels scaled to depth 1, (H, W, 3), so that point = depth * ray.

        Zeros where a lens shows no ray.
        """
        v, u = np.indices(self.shape, float)
        rays = np.nan_to_num(self.rays_at(u, v), nan=0.0).astype(np.float32)
        rays.setflags(write=False)
        return rays

    @cached_property
    def pixel_area(self) -> float:
        """Median area of a pixel at depth 1, m^2."""
        return pixel_area(self.rays)

    def rays_at(self, u: ArrayLike, v: ArrayLike) -> Floats:
        """Directions (..., 3) scaled to depth 1 of columns u and rows v (...); NaN without one."""
        with np.errstate(over='ignore', invalid='ignore'):
            y = (np.asarray(v, float) - self.cy) / self.fy
            x = (np.asarray(u, float) - self.cx - self.skew * y) / self.fx
        if self.distortion_model:
            x, y = undistort(x, y, self.distortion_model, self.d)
        rays = np.ones((*np.broadcast(x, y).shape, 3))
        rays[..., 0], rays[..., 1] = x, y
        rays[~(np.maximum(np.abs(x), np.abs(y)) <= _STEEPEST)] = np.nan
        return rays if self.turn == OPTICAL else rays @ self.axes.T


def pixel_area(rays: Singles) -> float:
    """Median area of a pixel of an image with `rays` (H, W, 3) at inverse range 1, m^2."""
    step = max(1, *(side // 16 for side in rays.shape[:2]))  # a few hundred pixels tell it
    here = rays[::step, ::step].astype(np.float64)
    across, down = np.diff(here, axis=1)[:-1], np.diff(here, axis=0)[:, :-1]
    area = np.linalg.norm(np.cross(across, down), axis=2) / step**2
    return float(np.median(area)) if area.size else 0.0


def positive_integer(name: str, value: Any) -> int:
    """`value` of the size of an image, or a `CameraError` that tells its name."""
    try:
        number = operator.index(value)
    except TypeError:
        number = -1
    # CameraInfo has 32 bits for it.
    if isinstance(value, bool) or not 0 < number < 2**32:
        raise CameraError(f'image size: {name} must be a positive whole number, not {value!r}')
    return number


def _finite(name: str, value: Any) -> float:
    try:
        if isinstance(value, bool | str):
            raise TypeError
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = np.nan
    if not np.isfinite(number):
        raise CameraError(f'{name} must be finite, not {value!r}')
    return number
