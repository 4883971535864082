"""The fixed distortion of a sensor, and images without it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage

# Intrinsics are those of one camera while they differ by less than this part of the width.
_SAME_CAMERA = 0.01


class DistortionError(ValueError):
    """A distortion map that is not one of the images at hand."""


@dataclass(frozen=True, eq=False)
class DistortionMap:
    """Error of the inverse depth of every pixel, along the optical axis.

    The error at an inverse depth y is offset + slope (y - reference).

    Attributes
    ----------
    offset : (H, W) float32
        1/m; 0 where it is not known. Without its free part: its least-squares plane
        a u + b v + c over the pixels that were seen is zero.
    deviation : (H, W) float32 or None
        Standard deviation of the error at the distances it was learned from, 1/m; 0 where it is
        not known.
    slope : (H, W) float32 or None
        Change of the error with y; None where it does not depend on it.
    camera : Camera or None
        Whose images it is for; None where that is not known.
    reference : float
        Inverse depth at which the error is the offset, 1/m.
    """

    offset: NDArray[np.float32]
    deviation: NDArray[np.float32] | None = None
    slope: NDArray[np.float32] | None = None
    camera: Camera | None = None
    reference: float = 0.0

    def corrected(self, image: RangeImage) -> RangeImage:
        """`image` without the distortion; `DistortionError` for another size or camera.

        An inverse range along unit rays, as of clouds, is the inverse depth times depth/range,
        and so is its error.
        """
        self._check(image)
        along = image.along
        error = self.offset
        if self.slope is not None:
            with np.errstate(divide='ignore', invalid='ignore'):
                inverse_depth = image.inverse / along
            error = error + self.slope * (inverse_depth - np.float32(self.reference))
        error = error * along
        inverse = np.where(image.inverse > 0, image.inverse - error, np.float32(0))
        # What remains beyond infinity was not measured.
        inverse = np.where(inverse > 0, inverse, np.float32(0))
        return replace(image, inverse=inverse, corrected=True)

    def _check(self, image: RangeImage) -> None:
        height, width = self.offset.shape
        if image.shape != self.offset.shape:
            raise DistortionError(
                f'the distortion map is {width}x{height}, '
                f'the image {image.shape[1]}x{image.shape[0]}'
            )
        own, other = self.camera, image.camera
        if own is None or other is None:
            return
        for name in ('fx', 'fy', 'cx', 'cy'):
            expected, found = getattr(own, name), getattr(other, name)
            if abs(expected - found) > _SAME_CAMERA * width:
                raise DistortionError(
                    f'the distortion map is of another camera: {name} {expected:g}, not {found:g}'
                )
