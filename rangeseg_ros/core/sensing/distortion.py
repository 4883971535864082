"""The fixed distortion of a sensor, and images without it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from rangeseg_ros.core.arrays import Floats, Singles
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage

# Intrinsics are those of one camera while they differ by less than this part of the width.
_SAME_CAMERA = 0.01


class DistortionError(ValueError):
    """A distortion map that is not one of the images at hand."""


@dataclass(frozen=True, eq=False)
class DistortionMap:
    """Error of the inverse depth y of every pixel (H, W): offset + slope (y - reference), 1/m.

    The offset is 0 where it is not known, and without its free part: its least-squares plane
    a u + b v + c over the pixels that were seen is zero.
    """

    offset: Singles
    # Standard deviation at the distances it was learned from, 0 where it is not known.
    deviation: Singles | None = None
    slope: Singles | None = None  # None where the error does not depend on y
    camera: Camera | None = None  # whose images it is for, where that is known
    reference: float = 0.0

    def corrected(self, image: RangeImage) -> RangeImage:
        """`image` without the distortion; `DistortionError` for another size or camera.

        An inverse range along unit rays, as of clouds, is the inverse depth times depth/range,
        and so is its error.
        """
        self._check(image)
        along, error = image.depth_over_range, self.offset
        if self.slope is not None:
            with np.errstate(divide='ignore', invalid='ignore'):
                inverse_depth = image.inverse / along
            error = error + self.slope * (inverse_depth - np.float32(self.reference))
        inverse = image.inverse - error * along
        # What remains beyond infinity was not measured.
        inverse = np.where(image.valid & (inverse > 0), inverse, np.float32(0))
        return replace(image, inverse=inverse, corrected=True)

    def _check(self, image: RangeImage) -> None:
        (height, width), (rows, columns) = self.offset.shape, image.shape
        if (height, width) != (rows, columns):
            raise DistortionError(
                f'the distortion map is {width}x{height}, the image {columns}x{rows}'
            )
        for name in ('fx', 'fy', 'cx', 'cy') if self.camera and image.camera else ():
            expected, found = getattr(self.camera, name), getattr(image.camera, name)
            if abs(expected - found) > _SAME_CAMERA * width:
                raise DistortionError(
                    f'the distortion map is of another camera: {name} {expected:g}, not {found:g}'
                )


def in_pixels(cells: Floats, side: int, shape: tuple[int, int]) -> Floats:
    """Values of square cells in the pixels (H, W), linear between the middles of the cells."""
    rows, columns = (n * side for n in cells.shape)
    whole = cv2.resize(cells, (columns, rows), interpolation=cv2.INTER_LINEAR)
    return np.asarray(whole, np.float64)[: shape[0], : shape[1]]
