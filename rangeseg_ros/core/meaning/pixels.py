"""Height and class of every pixel, by the ground continued and what is known of its cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.meaning.cells import CellSize
from rangeseg_ros.core.meaning.classes import DROP, GROUND, OBSTACLE, UNKNOWN
from rangeseg_ros.core.meaning.ground_field import GroundField, height_in_row, planes_of_row
from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.range_image import RangeImage


class Said(NamedTuple):
    """What is known of cells, (rows, columns).

    Attributes
    ----------
    kind : (...) int8
        Obstacle or drop as a whole, ground, or unknown.
    doubt : (...) float32
        Heights beyond it contradict that a pixel is ground, metres.
    unsure : (...) float32
        The noise of a height: no deeper, nothing is claimed to be a drop, metres.
    """

    kind: NDArray[np.int8]
    doubt: NDArray[np.float32]
    unsure: NDArray[np.float32]


def pixels_of(
    image: RangeImage,
    field: GroundField,
    size: CellSize,
    said: Said,
    bounds: tuple[float, float],
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Classes and heights of pixels.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    field : GroundField
    size : CellSize
    said : Said
    bounds : (float, float)
        Half of the least obstacle, and of the least drop, metres: what is not so high, or so
        deep, is more probably ground.

    Returns
    -------
    classes : (H, W) uint8
        0 where not measured.
    heights : (H, W) float32
        Along up above the ground, metres; NaN where not measured.
    """
    classes = np.zeros(image.shape, np.uint8)
    heights = np.full(image.shape, np.nan, np.float32)
    run_rows(_classify, len(said.kind), image.inverse, image.rays, field, size, said, bounds,
           classes, heights)  # fmt: skip
    return classes, heights


@njit(cache=True, nogil=True)
def _classify(
    first: int,
    after: int,
    inverse: NDArray[np.float32],
    rays: NDArray[np.float32],
    field: GroundField,
    size: CellSize,
    said: Said,
    bounds: tuple[float, float],
    classes: NDArray[np.uint8],
    heights: NDArray[np.float32],
) -> None:
    """Of cells first...after along the columns.

    Ten parameters, as a kernel cannot return what several threads write.
    """
    line = np.empty((field.theta.shape[1], 4))
    # Divisions would take as long as all the rest.
    blocks, cells = 1 / field.columns, 1 / size.columns
    for i in range(first * size.rows, min(after * size.rows, len(inverse))):
        row = i // size.rows
        planes_of_row(field, i, line)
        for j in range(inverse.shape[1]):
            value = inverse[i, j]
            if value == 0:
                continue
            height = height_in_row(line, (j + 0.5) * blocks - 0.5, value, rays[i, j])
            heights[i, j] = height
            c = int((j + 0.5) * cells)
            kind = said.kind[row, c]
            if kind > GROUND:
                classes[i, j] = kind
            elif kind == GROUND and abs(height) < said.doubt[row, c]:
                classes[i, j] = GROUND
            elif height > bounds[0]:
                classes[i, j] = OBSTACLE
            elif height < -bounds[1]:
                classes[i, j] = DROP if height < -said.unsure[row, c] else UNKNOWN
            else:
                classes[i, j] = GROUND
