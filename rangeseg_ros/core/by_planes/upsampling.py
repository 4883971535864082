"""What every second, or fourth, column and row tells, for all pixels."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.plane_energy import CAP, NO_PLANE
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.marks import no_marks
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.ray_rows import ray_of
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance


def labels_of_all(
    few: NDArray[np.uint16],
    step: int,
    image: RangeImage,
    whole: RangeImage,
    theta: NDArray[np.float64],
    sensor: SensorModel,
    smoothness: float,
) -> tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.intp]]:
    """Labels of all pixels from those of every `step`-th column and row.

    A pixel between them takes that label, of the two or four around it, of the least energy
    (thesis eq. 5.3): residuals as in `plane_energy`, and Potts, as if of its four neighbours so
    many were unlike as of the measured ones around.

    Parameters
    ----------
    few : (ceil(H / step), ceil(W / step)) uint16
        0...M; 0 = no plane.
    step : int
    image : RangeImage
        (H, W), as it was measured.
    whole : RangeImage
        (H, W), holes bridged.
    theta : (M + 1, 3) float64
        The planes: theta . ray = inverse.
    sensor : SensorModel
        Errors of the image.
    smoothness : float
        What it costs to be unlike a neighbour.

    Returns
    -------
    regions : (H, W) uint16
        0...M, those of bridged pixels too.
    labels : (H, W) uint16
        The same, 0 for what was not measured.
    counts : (M + 1,) int
        Measured pixels of each label.
    """
    regions, labels = np.empty(image.shape, np.uint16), np.empty(image.shape, np.uint16)
    planes = theta, sensor, 4 * smoothness
    pixels = image.inverse, whole.inverse, whole.rays, whole.pinhole
    upper, lower = map_halves(_tell, len(labels), few, step, *planes, *pixels, regions, labels)
    return regions, labels, upper + lower


@njit(cache=True, nogil=True)
def _tell(
    first: int,
    after: int,
    few: NDArray[np.uint16],
    step: int,
    theta: NDArray[np.float64],
    sensor: SensorModel,
    unlike: float,
    inverse: NDArray[np.float32],
    bridged: NDArray[np.float32],
    rays: NDArray[np.float32],
    pinhole: bool,
    regions: NDArray[np.uint16],
    labels: NDArray[np.uint16],
) -> NDArray[np.intp]:
    """Fill in some rows; `unlike` is what it costs to be unlike all around."""
    columns, width = few.shape[1], inverse.shape[1]
    counts = np.zeros(len(theta), np.intp)
    # Each word tells of eight pixels whether there is a border between them and the next.
    edge = no_marks(columns)
    eight = edge.view(np.uint64)
    for row in range(first, after):
        above = row // step
        below = above if row == above * step else min(above + 1, len(few) - 1)
        upper, lower = few[above], few[below]
        top, bottom = bridged[above * step, ::step], bridged[below * step, ::step]
        _find_edges(upper, lower, edge)
        left = 0
        while left < columns:
            begin = left
            while left < columns and edge[left] == 0:
                left += 8 if left % 8 == 0 and eight[left // 8] == 0 else 1
            left = min(left, columns)
            part, label = slice(begin * step, min(left * step, width)), upper[begin]
            _fill(label, bridged[row, part], regions[row, part])
            counts[label] += _fill(label, inverse[row, part], labels[row, part])
            for column in range(left * step, min((left + 1) * step, width)):
                label, y = upper[left], bridged[row, column]
                if y > 0:
                    right = left if column == left * step else min(left + 1, columns - 1)
                    around = label, lower[left], upper[right], lower[right]
                    known = top[left], bottom[left], top[right], bottom[right]
                    squared = y * y
                    variance = random_variance(sensor, squared)
                    variance += systematic_variance(sensor, squared)
                    ray = ray_of(rays, pinhole, row, column)
                    label = _best(around, known, y, ray, theta, variance, unlike)
                regions[row, column] = label if y > 0 else 0
                measured = inverse[row, column] > 0
                labels[row, column] = label if measured else 0
                counts[label] += measured
            left += 1
    return counts


@njit(cache=True, nogil=True)
def _find_edges(
    upper: NDArray[np.uint16], lower: NDArray[np.uint16], edge: NDArray[np.uint8]
) -> None:
    """Whether a pixel of two rows, the one below it or those to their right have another label."""
    # Views, of which the compiler takes many pixels at a time.
    last = len(upper) - 1
    right, beside = upper[1:], lower[1:]
    for j in range(last):
        edge[j] = (upper[j] != right[j]) | (upper[j] != lower[j]) | (upper[j] != beside[j])
    edge[last] = upper[last] != lower[last]


@njit(cache=True, nogil=True)
def _fill(label: int, inverse: NDArray[np.float32], found: NDArray[np.uint16]) -> int:
    """Give a label to the measured pixels of a part of a row, 0 to others; how many they are."""
    none, measured = label ^ label, 0
    for j in range(len(found)):
        found[j] = label if inverse[j] > 0 else none
        measured += inverse[j] > 0
    return measured


@njit(cache=True, nogil=True)
def _best(
    around: tuple[int, int, int, int],
    known: tuple[float, float, float, float],
    y: float,
    ray: tuple[float, float, float],
    theta: NDArray[np.float64],
    variance: float,
    unlike: float,
) -> int:
    """Of the labels around a pixel, the one of the least energy; `known` are their inverses."""
    if around[0] == around[1] == around[2] == around[3]:
        return around[0]
    share = unlike / max((known[0] > 0) + (known[1] > 0) + (known[2] > 0) + (known[3] > 0), 1)
    best, least = around[0], np.inf
    for k in range(4):
        label, cost, first = around[k], 0.0, True
        for m in range(4):
            differs = around[m] != label
            first &= differs | (m >= k)
            cost += share * ((known[m] > 0) & differs)
        if not first or cost >= least:
            continue
        if label > 0:
            residual = y - theta[label, 0] * ray[0] - theta[label, 1] * ray[1]
            residual -= theta[label, 2] * ray[2]
            cost += min(residual * residual / (2 * variance), CAP)
        else:
            cost += NO_PLANE
        if cost < least:
            best, least = label, cost
    return best
