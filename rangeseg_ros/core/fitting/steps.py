"""The smallest step of the inverse range that is a jump and no noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.fitting.noise import ROUGH
from rangeseg_ros.core.runtime.threads import run_rows
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.moments import COUNT
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, tilt_variance


class Steps(NamedTuple):
    """Which steps of the inverse range are jumps, of blocks (rows, columns), 1/m.

    Of a block that is not flat, by what is known of the flat ones beside it.

    Attributes
    ----------
    windows : (rows, columns) float32
        Smallest jump between means of windows: that of the flattest surface.
    pixels : (rows, columns) float32
        The same between pixels, which may be any surface's: that of the noisiest.
    slopes : (rows, columns) float32
        Change of the inverse range from pixel to pixel on the flattest surface.
    """

    windows: NDArray[np.float32]
    pixels: NDArray[np.float32]
    slopes: NDArray[np.float32]


def jump_steps(blocks: Blocks, sensor: SensorModel) -> Steps:
    """Smallest step of the inverse range that is a jump, and the slope of the surface.

    Second differences of means of 3 x 3 pixels, that jump edges are found by, have 0.72 times
    the variance of `agreement` for white and correlated noise alike (0.67 to 0.76), and five
    standard deviations are no noise. Rounding alone makes steps of one quantum, and of two
    where noise adds to it.

    Parameters
    ----------
    blocks : Blocks
        (rows, columns).
    sensor : SensorModel
    """
    shape = blocks.squared.shape
    steps = Steps(*(np.empty(shape, np.float32) for _ in range(3)))
    run_rows(_find_steps, shape[0], blocks, sensor, 25 * 0.72 * sensor.agreement, steps)
    return steps


@njit(cache=True, nogil=True)
def _find_steps(
    first: int,
    after: int,
    blocks: Blocks,
    sensor: SensorModel,
    factor: float,
    steps: Steps,
) -> None:
    """The same of some rows of blocks, in loops without branches but where a block is not flat."""
    rows, columns = steps.windows.shape
    # Squared slopes of the flat blocks of three rows of blocks in turn with the variances that
    # they add, and those taken for one row: of the flattest, and the largest.
    flat, tilted = np.full((3, columns + 2), np.inf), np.zeros((3, columns + 2))
    slope, tilt, rough = np.empty((3, columns))
    for i in range(first - 1, after + 1):
        flat[i % 3] = np.inf
        if 0 <= i < rows:
            _find_flat(i, blocks, sensor, flat[i % 3], tilted[i % 3])
        if i <= first:
            continue
        for j in range(columns):
            slope[j], tilt[j] = flat[(i - 1) % 3, j + 1], tilted[(i - 1) % 3, j + 1]
            rough[j] = tilt[j]
            if slope[j] == np.inf:
                # That of a block that a jump crosses is the jump's: its neighbours' then.
                rough[j] = 0.0
                for k in range(3):
                    for m in range(j, j + 3):
                        if flat[k, m] < slope[j]:
                            slope[j], tilt[j] = flat[k, m], tilted[k, m]
                        if flat[k, m] < np.inf:
                            rough[j] = max(rough[j], tilted[k, m])
                if slope[j] == np.inf:
                    slope[j] = tilt[j] = 0.0
        for j in range(columns):
            squared = blocks.squared[i - 1, j]
            variance = random_variance(sensor, squared)
            rounding = 2.2 * max(sensor.quantum, sensor.range_quantum * squared)
            steps.windows[i - 1, j] = max(np.sqrt(factor * (variance + tilt[j])), rounding)
            steps.pixels[i - 1, j] = max(np.sqrt(factor * (variance + rough[j])), rounding)
            steps.slopes[i - 1, j] = np.sqrt(slope[j])


@njit(cache=True, nogil=True)
def _find_flat(
    i: int,
    blocks: Blocks,
    sensor: SensorModel,
    flat: NDArray[np.float64],
    tilted: NDArray[np.float64],
) -> None:
    """Slopes of the blocks of a row of which noise explains what their planes leave.

    `flat` has a margin of one, in which it keeps what it holds; infinite for the other blocks.
    `tilted` are the variances that slopes add.
    """
    for j in range(blocks.squared.shape[1]):
        count, slope = blocks.moments[i, j, COUNT], blocks.across[i, j] + blocks.down[i, j]
        tilt = tilt_variance(sensor, blocks.across[i, j], blocks.down[i, j])
        variance = random_variance(sensor, blocks.squared[i, j]) + tilt
        is_flat = (count > 3) & (blocks.residual[i, j] < ROUGH * variance * (count - 3))
        flat[j + 1] = slope if is_flat else np.inf
        tilted[j + 1] = tilt
