"""What every second, or fourth, column and row tells, for all pixels."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.plane_energy import CAP, NO_PLANE
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.marks import find_marked, no_marks
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
        Measured pixels of each plane; 0 for none.
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
    # Where the labels around a pixel differ, and where a label ends: in few places of a row.
    edge, change = no_marks(columns), no_marks(width)
    places = np.empty(len(change), np.intp)
    around = np.empty(columns * step, np.uint16)
    for row in range(first, after):
        above = row // step
        exact = row == above * step
        below = above if exact else min(above + 1, len(few) - 1)
        if exact or row == first:
            _spread(few[above], step, around)
        _fill(around, bridged[row], regions[row])
        _fill(around, inverse[row], labels[row])
        _find_edges(few[above], few[below], edge)
        for place in places[: find_marked(edge, 0, places)]:
            left = int(place)
            for column in range(left * step + exact, min((left + 1) * step, width)):
                y = bridged[row, column]
                if y == 0:
                    continue
                right = left if column == left * step else min(left + 1, columns - 1)
                squared = y * y
                variance = random_variance(sensor, squared)
                variance += systematic_variance(sensor, squared)
                pixel = y, ray_of(rays, pinhole, row, column), variance, unlike
                one, last = (above, left), (below, right)
                if exact or right == left:
                    label = _best((one, last), few, step, bridged, theta, pixel)
                else:
                    four = one, (below, left), (above, right), last
                    label = _best(four, few, step, bridged, theta, pixel)
                regions[row, column] = label
                labels[row, column] = label if inverse[row, column] > 0 else 0
        _find_changes(labels[row], change)
        begin = 0
        for place in places[: find_marked(change, 0, places)]:
            counts[labels[row, begin]] += place + 1 - begin
            begin = int(place) + 1
    counts[0] = 0
    return counts


@njit(cache=True, inline='always')
def _spread(few: NDArray[np.uint16], step: int, many: NDArray[np.uint16]) -> None:
    """Repeat each label of a row so many times, most often at a distance the compiler knows."""
    if step == 2:
        for j in range(len(few)):
            many[2 * j] = many[2 * j + 1] = few[j]
    else:
        for k in range(step):
            many[k::step] = few


@njit(cache=True, nogil=True)
def _fill(
    around: NDArray[np.uint16], inverse: NDArray[np.float32], found: NDArray[np.uint16]
) -> None:
    """Give their labels to the measured pixels of a row, 0 to others."""
    for j in range(len(found)):
        label = around[j]
        found[j] = label if inverse[j] > 0 else label ^ label


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
def _find_changes(row: NDArray[np.uint16], change: NDArray[np.uint8]) -> None:
    """Mark the last pixel of each label side by side."""
    last, right = len(row) - 1, row[1:]
    for j in range(last):
        change[j] = row[j] != right[j]
    change[last] = 1


@njit(cache=True, inline='always')
def _best(
    around: tuple[tuple[int, int], ...],
    few: NDArray[np.uint16],
    step: int,
    bridged: NDArray[np.float32],
    theta: NDArray[np.float64],
    pixel: tuple[float, tuple[float, float, float], float, float],
) -> int:
    """Of the labels `around` a pixel, two or four places in `few`, the one of the least energy.

    Of the pixel its inverse range, ray and variance, and what it costs to be unlike all around.
    """
    y, ray, variance, unlike = pixel
    known = 0
    for i, j in around:
        known += bridged[i * step, j * step] > 0
    share = unlike / max(known, 1)
    best, least = few[around[0]], np.inf
    for place in around:
        label, others = few[place], 0
        for i, j in around:
            others += (bridged[i * step, j * step] > 0) & (few[i, j] != label)
        residual = y - theta[label, 0] * ray[0] - theta[label, 1] * ray[1]
        residual -= theta[label, 2] * ray[2]
        misfit = min(residual * residual / (2 * variance), CAP) if label > 0 else NO_PLANE
        if share * others + misfit < least:
            best, least = label, share * others + misfit
    return best
