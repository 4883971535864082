"""The range image every later step reads: rays, inverse range, validity."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.arrays import Floats, Mask, Singles
from rangeseg_ros.core.sensing.camera import OPTICAL, Camera, pixel_area
from rangeseg_ros.core.sensing.clouds import axes_of_frame, camera_of, depth_of


class RangeImageError(ValueError):
    """An array that is no depth image or organised cloud, or does not fit its camera."""


class UnitWarning(UserWarning):
    """Ranges that look as if they were in another unit."""


FAR = 65.0  # the farthest that 16 bits of millimetres tell, metres
NEAR = 0.01  # nearer than any depth camera measures, metres
NOT_MEASURED = 65535  # what drivers and data sets write for it beside 0


@dataclass(frozen=True, eq=False, repr=False)
class RangeImage:
    """Measurements along pixel rays: point = place + ray / inverse.

    Seen from that place, a plane n . p + d = 0 is linear in this form: (-n/d) . ray = inverse,
    which holds for the pinhole camera (rays scaled to z = 1, inverse = 1/z) as for any cloud (unit
    rays, inverse = 1/range).

    Attributes
    ----------
    rays : (H, W, 3) float32
        Ray of each pixel, in the frame of the camera or of the points; undefined where invalid
        when the image comes from points.
    inverse : (H, W) float32
        Inverse depth (pinhole) or inverse range (cloud), 1/m; 0 where nothing was measured.
    camera : Camera or None
        None for organised clouds of other sensors.
    corrected : bool
        Whether the sensor's fixed distortion has been subtracted.
    body : (H, W) bool or None
        Pixels that show the robot itself, which are not measured; None where no mask tells.
    """

    rays: Singles
    inverse: Singles
    camera: Camera | None = None
    corrected: bool = False
    body: Mask | None = None

    def __post_init__(self) -> None:
        # Like those of cameras, or every kernel that reads them is compiled twice.
        self.rays.flags.writeable = False

    def __repr__(self) -> str:
        kind = 'organised cloud' if self.camera is None else 'depth image'
        measured, said = self.inverse[self.valid], 'nothing measured'
        if len(measured):
            said = f'{measured.size / self.inverse.size:.0%} measured, '
            said += f'{1 / measured.max():.3g} to {1 / measured.min():.3g} m'
        return f'<RangeImage {self.shape[1]}x{self.shape[0]}, {kind}, {said}>'

    @classmethod
    def from_depth(
        cls, depth: ArrayLike, camera: Camera, scale: float | None = None
    ) -> RangeImage:
        """Range image of a depth image (REP 118).

        Parameters
        ----------
        depth : (H, W) integers or floats, of either byte order
            Depth along the optical axis; 0, negative values and 65535 (integers), non-finite or
            <= 0 (floats) and what the mask of a masked array hides are invalid.
        camera : Camera
            Intrinsics; its size must be the image's.
        scale : float, optional
            Metres per unit; 0.001 for integers and 1 for floats when not given.

        Raises
        ------
        RangeImageError
            Not a 2-D image of these types, no camera, a size other than the camera's, a scale
            that is not positive.

        Warns
        -----
        UnitWarning
            More than half of the pixels are farther than 16 bits of millimetres reach, or nearer
            than any camera measures. Or there are 8 bits and no scale, as of a picture of depth.
        """
        array, hidden = _unmasked(depth)
        if array.ndim != 2:
            given = array.shape if array.ndim else f'{depth!r:.60}'
            hint = '; points need no camera' if array.shape[2:] == (3,) else ''
            hint = hint if array.ndim else '; cv2.imread(path, cv2.IMREAD_UNCHANGED) reads files'
            raise RangeImageError(f'depth image must be of shape (H, W), not {given}{hint}')
        if not isinstance(camera, Camera):
            raise RangeImageError(
                'camera must be a Camera(width, height, fx, fy, cx, cy), Camera.from_fov(...) or '
                f'camera_from_matrices(...), not of type {type(camera).__name__}'
            )
        integers = array.dtype.kind in 'iu'
        if not integers and array.dtype.kind != 'f':
            raise RangeImageError(f'depth must be of integers or floats, not {array.dtype}')
        height, width = array.shape
        if array.shape != camera.shape:
            raise RangeImageError(
                f'depth image is {width}x{height}, its camera {camera.width}x{camera.height}'
            )
        if scale is None:
            scale = 0.001 if integers else 1.0
            if array.itemsize == 1:
                warnings.warn(
                    'depth of 8 bits has no unit: state the scale', UnitWarning, stacklevel=2
                )
        if not (isinstance(scale, Real) and np.isfinite(scale) and scale > 0):
            raise RangeImageError(f'depth scale must be a positive number, not {scale!r}')
        if integers and array.dtype != np.uint16:
            # Older readers of 16-bit images give wider integers; those of 32 bits may be finer.
            array = np.where(array == NOT_MEASURED, 0, array)
            if array.max(initial=0) < NOT_MEASURED:
                array = np.maximum(array, 0).astype(np.uint16)
        inverse = _reciprocal(array, scale)
        if hidden is not None:
            inverse[hidden] = 0
        if camera.distortion_model:
            inverse[~camera.rays.any(axis=2)] = 0
        image = cls(camera.rays, inverse, camera)
        # Millimetres of 16 bits are never as far.
        if not integers or scale > 0.001:
            image._doubt_unit()
        return image

    @classmethod
    def from_points(cls, points: ArrayLike) -> RangeImage:
        """Range image of an organised cloud of any sensor.

        That of a pinhole camera is what its depth image is (see `camera_of`), in the frame of
        the points.

        Parameters
        ----------
        points : (H, W, 3) float
            Points in metres, in a frame of any axes, with the sensor at its origin unless it is a
            pinhole camera; any coordinate that is not finite or hidden by the mask of a masked
            array, or a point at the origin, is invalid.

        Raises
        ------
        RangeImageError
            An array of another shape or type, or an empty one.

        Warns
        -----
        UnitWarning
            More than half of the points are as far, or as near, as no depth camera measures.
        """
        array, hidden = _unmasked(points)
        if array.ndim != 3 or array.shape[2] != 3 or array.dtype.kind != 'f' or not array.size:
            hint = '; a depth image needs its camera' if array.ndim == 2 else ''
            raise RangeImageError(
                f'organised cloud must be (H, W, 3) float, not {array.shape} {array.dtype}{hint}'
            )
        x, y, z = array[..., 0], array[..., 1], array[..., 2]
        with np.errstate(invalid='ignore', over='ignore'):
            known = np.isfinite(x + y + z) & ((x != 0) | (y != 0) | (z != 0))
        if hidden is not None:
            known &= ~hidden.any(axis=2)
        camera = camera_of(array, known)
        if camera is not None:
            return cls.from_depth(np.where(known, depth_of(array, camera), 0), camera)
        cloud = np.where(known[..., None], array, 0).astype(np.float64)
        with np.errstate(over='ignore'):
            inverse = _reciprocal(np.sqrt(np.einsum('ijk,ijk->ij', cloud, cloud)), 1.0)
        image = cls((cloud * inverse[..., None]).astype(np.float32), inverse)
        image._doubt_unit()
        return image

    def dithered(self, sigma: float, seed: int) -> RangeImage:
        """Copy with Gaussian noise of this standard deviation, metres, on the ranges (6.7.1)."""
        noise = np.random.default_rng(seed).normal(0.0, sigma, self.shape)
        with np.errstate(divide='ignore'):
            return replace(self, inverse=_reciprocal(1 / self.inverse + noise, 1.0))

    def without(self, body: Mask) -> RangeImage:
        """Copy without the pixels that show the robot's own body: (H, W), of the image's size."""
        (height, width), (rows, columns) = body.shape, self.shape
        if body.shape != self.shape:
            raise RangeImageError(f'the mask is {width}x{height}, the image {columns}x{rows}')
        return replace(self, inverse=np.where(body, np.float32(0), self.inverse), body=body)

    def _doubt_unit(self) -> None:
        known = self.inverse[self.valid]
        for off, far in ((known < 1 / FAR, f'beyond {FAR}'), (known > 1 / NEAR, f'below {NEAR}')):
            if 2 * np.count_nonzero(off) > known.size:
                message = f'more than half of the ranges are {far} m: are they in metres?'
                warnings.warn(message, UnitWarning, stacklevel=3)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        height, width = self.inverse.shape
        return height, width

    @property
    def pinhole(self) -> bool:
        """Whether rays differ along the rows in x alone, and along the columns in y alone."""
        return self.camera is not None and self.camera.pinhole and self.camera.turn == OPTICAL

    @cached_property
    def axes(self) -> Floats:
        """(3, 3) what is right, down and forward in the image, as columns, in its frame.

        The identity in an optical frame. Of clouds of other sensors, the nearest axes.
        """
        if self.camera is not None:
            return self.camera.axes
        return axes_of_frame(self.rays, self.valid)

    @property
    def place(self) -> Floats:
        """(3,) where the sensor is in the frame of the points, metres."""
        return np.array(self.camera.place if self.camera is not None else (0.0, 0.0, 0.0))

    @property
    def level_up(self) -> Floats:
        """(3,) up in the frame of the image where that is level.

        By REP 103: -y in optical frames, which look along z, and z in all others.
        """
        looks = self.axes[:, 2]
        return np.array([0.0, -1, 0] if looks[2] > np.abs(looks[:2]).max() else [0.0, 0, 1])

    @property
    def depth_over_range(self) -> Singles:
        """(H, W) depth over range, which is inverse range over inverse depth; 1 for cameras."""
        if self.camera is not None:
            return np.ones(self.shape, np.float32)
        along: Singles = self.rays @ self.axes[:, 2].astype(np.float32)
        return along

    @cached_property
    def pixel_area(self) -> float:
        """Median area of a pixel at inverse range 1, m^2."""
        return pixel_area(self.rays) if self.camera is None else self.camera.pixel_area

    @cached_property
    def valid(self) -> Mask:
        """(H, W) True where there is a measurement; the rest is shadow (thesis 6.7)."""
        return self.inverse > 0

    @cached_property
    def points(self) -> Singles:
        """(H, W, 3) points in metres, NaN where nothing was measured."""
        with np.errstate(divide='ignore', invalid='ignore'):
            points = self.rays / self.inverse[..., None]
        points += self.place
        points[~self.valid] = np.nan
        return points


# Metres; what lies outside was not measured by any sensor, and its squares leave float32.
_NEAREST, _FARTHEST = 1e-6, 1e6


def _reciprocal(distance: NDArray, scale: float) -> Singles:
    """1 / (scale * distance) in 1/m, 0 where that is no distance from 1 um to 1000 km."""
    if distance.dtype == np.uint16:
        # No index is beyond the table; without a look for one it takes a third of the time.
        return _reciprocals(scale).take(distance, mode='clip')
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        metres = distance.astype(np.float64) * scale
        inverse = (1.0 / metres).astype(np.float32)
    inverse[~((metres >= _NEAREST) & (metres <= _FARTHEST))] = 0
    return inverse


@lru_cache(maxsize=4)
def _reciprocals(scale: float) -> Singles:
    """Of the 65536 values there can be."""
    inverse = _reciprocal(np.arange(65536, dtype=np.float64), scale)
    inverse[NOT_MEASURED] = 0
    return inverse


def _unmasked(values: ArrayLike) -> tuple[NDArray, Mask | None]:
    """Values as a plain array, and where a mask hides them."""
    if isinstance(values, np.ma.MaskedArray):
        return values.data, np.ma.getmaskarray(values)
    try:
        return np.asarray(values), None
    except ValueError:
        raise RangeImageError(f'no array: rows differ in length: {values!r:.60}') from None
