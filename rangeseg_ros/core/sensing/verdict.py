"""Whether an image is what it is taken for: enlarged, filled, range for depth, a wrong unit.

Each of these leaves exact traces in the image itself. Replicated pixels are also undone here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import FAR, RangeImage

_SIGNIFICANT = 5.0
"""Standard errors that a statistic of an image must differ by, not to be chance in any image."""
_ODDS = float(np.log(1e4))
"""Logarithm of the odds at which one reading of an image is believed and not the other."""
_SPREAD = 0.2
"""By which the bends of real planes differ, of that of a plane whose range is taken for depth."""
_FEWEST = 40
"""Pixels that tell the bend of a plane."""
_LINES, _FEW, _SAMPLE = 60, 24, 5000
"""Rows or columns, those whose spectrum is looked at, and pixels, that stand for an image."""
_LARGEST = 16
"""Enlargement that is looked for."""
_KINECT_STEP = 1 / (8 * 580 * 0.075)
"""Step of the inverse depth of a Kinect, 1/m: an eighth of a pixel at 580 px and 75 mm."""
_WRONG_UNITS = (5.0, 0.2, 10.0, 0.1, 1000.0, 0.001)
"""Quotients of the units that files have: 1/1000, 1/5000 and 1/10000 m, and metres."""


class Verdict(NamedTuple):
    """What is doubtful about an image.

    Attributes
    ----------
    reasons : tuple of str
        Such as `enlarged x 4`, `filled 12 %`, `range instead of z`, `scale improbable`,
        `millimetres in floats`, `curved scene`, `distortion not identifiable`; empty where
        nothing is.
    details : tuple of str
        A sentence for each.
    """

    reasons: tuple[str, ...] = ()
    details: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether nothing speaks against the image."""
        return not self.reasons

    @property
    def invalid(self) -> bool:
        """Whether every metric result is wrong, not only less certain."""
        return any(reason in _INVALID for reason in self.reasons)

    def __str__(self) -> str:
        return ' '.join(self.details) or 'trusted'


_INVALID = ('range instead of z', 'scale improbable', 'millimetres in floats')


def judge(
    image: RangeImage,
    labels: NDArray[np.uint16],
    planes: Mapping[int, NDArray[np.float64]],
    curved: NDArray[np.uint16] | None = None,
    identified: bool = True,
) -> Verdict:
    """Look for what makes an image doubtful.

    Parameters
    ----------
    image : RangeImage
    labels : (H, W) uint16
        Of what was found in it.
    planes : mapping of int to (3,) float64
        Label -> theta, theta . ray = inverse.
    curved : (H, W) uint16, optional
        Not 0 on surfaces that are smooth and no planes.
    identified : bool
        False where the image was to tell the errors of the sensor and does not.
    """
    found: dict[str, str] = {}
    if cells := enlargement(image):
        found[f'enlarged x {cells.factor}'] = (
            f'Each measurement fills {cells.factor} x {cells.factor} pixels: the image was '
            'enlarged; use the original.'
        )
    elif (share := filled_share(image)) > 0.01:
        found[f'filled {share:.0%}'.replace('%', ' %')] = (
            'Pixels beside edges copy their neighbours: holes were filled; switch that off.'
        )
    if shows_range(image, labels, planes):
        found['range instead of z'] = (
            'Surfaces are flat only if the values are distances from the camera, not along its '
            'axis: multiply them by 1 / |ray|.'
        )
    if 2 * np.count_nonzero(image.inverse[image.valid] < 1 / FAR) > np.count_nonzero(image.valid):
        found['millimetres in floats'] = (
            f'More than half of the image is beyond {FAR:.0f} m: the values are not in metres.'
        )
    elif factor := improbable_scale(image):
        times = f'{factor:g} times too far' if factor > 1 else f'{1 / factor:g} times too near'
        found['scale improbable'] = (
            f'The steps of the depth are those of a Kinect whose image is read {times}: '
            'check the depth scale (TUM: 0.0002).'
        )
    if curved is not None and np.count_nonzero(curved) > np.count_nonzero(labels):
        found['curved scene'] = (
            'More pixels are on curved surfaces than on planes: a part of the planes may be '
            'curved, too.'
        )
    if not identified and image.valid.any():
        found['distortion not identifiable'] = (
            'Too little of the image is flat to measure noise and distortion: those of the '
            'parameters are used.'
        )
    return Verdict(tuple(found), tuple(found.values()))


class Cells(NamedTuple):
    """Squares of pixels that hold one measurement each.

    Attributes
    ----------
    factor : int
        Pixels along a side.
    rows, columns : int
        How many of the first cell are cropped.
    """

    factor: int
    rows: int
    columns: int

    def reduced(self, image: RangeImage) -> RangeImage:
        """The image with a pixel for each cell, the cropped ones included."""
        k, (height, width) = self.factor, image.shape
        v = np.clip(np.arange(k // 2 - self.rows, height + k // 2, k), 0, height - 1)
        u = np.clip(np.arange(k // 2 - self.columns, width + k // 2, k), 0, width - 1)
        v, u = v[: -(-(height + self.rows) // k)], u[: -(-(width + self.columns) // k)]
        picked = np.ix_(v, u)
        camera = _camera_of_cells(self, image.camera) if image.camera else None
        rays = image.rays[picked] if camera is None else camera.rays
        # Like those of cameras, or every kernel that reads them is compiled twice.
        rays.flags.writeable = False
        body = None if image.body is None else image.body[picked]
        return replace(image, rays=rays, inverse=image.inverse[picked], camera=camera, body=body)

    def enlarged(self, array: NDArray, shape: tuple[int, int]) -> NDArray:
        """Values (h, w, ...) of the cells for all pixels of an image (H, W)."""
        v = (np.arange(shape[0]) + self.rows) // self.factor
        u = (np.arange(shape[1]) + self.columns) // self.factor
        return array[np.ix_(v, u)]


@lru_cache(maxsize=4)
def _camera_of_cells(cells: Cells, camera: Camera) -> Camera:
    # Kept, as its rays are worked out only once. A cell's measurement is of its centre.
    k, middle = cells.factor, (cells.factor - 1) / 2
    return replace(
        camera,
        width=-(-(camera.width + cells.columns) // k),
        height=-(-(camera.height + cells.rows) // k),
        fx=camera.fx / k,
        fy=camera.fy / k,
        cx=(camera.cx + cells.columns - middle) / k,
        cy=(camera.cy + cells.rows - middle) / k,
        skew=camera.skew / k,
    )


def enlargement(image: RangeImage) -> Cells | None:
    """Cells of one measurement each, where an image was enlarged; None where it was not."""
    return replication(image) or interpolation(image)


def replication(image: RangeImage) -> Cells | None:
    """Cells of equal values, as nearest neighbours enlarge an image; None where there are none.

    Neighbours differ at the borders of the cells only, so that the columns at which any differ are
    multiples of the factor apart, and so are the rows. At least half of the borders must show it:
    a few edges of an exact scene may lie at multiples by chance.
    """
    inverse = image.inverse
    columns = _period(inverse[:: max(len(inverse) // _LINES, 1)])
    if columns is None:
        return None
    rows = _period(inverse[:, :: max(inverse.shape[1] // _LINES, 1)].T)
    if rows is None or rows[0] != columns[0]:
        return None
    return Cells(columns[0], rows[1], columns[1])


def _period(lines: NDArray[np.float32]) -> tuple[int, int] | None:
    """Distance of the columns at which values change, and what the first one lacks."""
    before, after = lines[:, :-1], lines[:, 1:]
    changes = np.flatnonzero(((before != after) & (before > 0) & (after > 0)).any(axis=0)) + 1
    if len(changes) < 2:
        return None
    period = int(np.gcd.reduce(np.diff(changes)))
    few = 2 * len(changes) * period < lines.shape[1]
    if few or not 2 <= period <= _LARGEST:
        return None
    return period, int(-changes[0] % period)


def interpolation(image: RangeImage) -> Cells | None:
    """Cells between whose centres the depth is linear; None where it is not.

    Second differences along a line vanish but beside the centres, at every k-th pixel: their
    mean size per column has a line in its spectrum (Fisher, Tests of significance in harmonic
    analysis, 1929). For k = 2, third differences have one. Which pixels are the centres does not
    matter: one of every k x k pixels is as good as another.
    """
    for order, least in ((2, 3), (3, 2)):
        both = np.full(_LARGEST + 1, np.inf)
        for lines in (image.inverse, image.inverse.T):
            some = lines[:: max(len(lines) // _FEW, 1)]
            if (both[least:] > _SIGNIFICANT).any():
                both = np.minimum(both, _spectrum(some, order))
        periods = [k for k in range(least, _LARGEST + 1) if both[k] > _SIGNIFICANT]
        if periods and (order == 2 or 2 in periods):
            # Of a period all divisors show.
            return Cells(max(periods) if order == 2 else 2, 0, 0)
    return None


def _spectrum(lines: NDArray[np.float32], order: int) -> NDArray[np.float64]:
    """Amplitude of the differences' size at each period 0..._LARGEST, in standard errors."""
    amplitude = np.zeros(_LARGEST + 1)
    with np.errstate(divide='ignore', invalid='ignore'):
        size = np.abs(np.diff(1 / lines.astype(np.float64), order))
        distance = 1 / lines[:, : size.shape[1]]
    known = np.isfinite(size)
    # Of float32, and of sensors whose steps are wide, many are 0.
    changes = size[known & (size > 1e-5 * distance)]
    if not len(changes):
        return amplitude
    # Edges of objects are no part of it.
    size = np.where(known, np.minimum(size, 2 * np.median(changes)), 0)
    counts = known.sum(axis=0)
    columns = np.flatnonzero(counts)
    means = size.sum(axis=0)[columns] / counts[columns]
    if len(columns) < 2 * _LARGEST or not means.std():
        return amplitude
    periods = np.arange(2, _LARGEST + 1)
    waves = np.exp(2j * np.pi * columns / periods[:, None])
    amplitude[2:] = np.abs((waves * (means - means.mean())).sum(axis=1)) / (
        means.std() * len(columns) ** 0.5
    )
    return amplitude


def filled_share(image: RangeImage) -> float:
    """Share of the pixels that copy a neighbour up to an edge, more than do so from there on.

    Filters that fill holes continue a pixel to the far side of the hole: runs of equal values end
    at jumps, and do not begin there. Steps of the sensor make as many of either.
    """
    if image.camera is None:
        return 0.0
    most = 0.0
    for lines in (image.inverse[::4], image.inverse[:, ::4].T):
        measured = np.count_nonzero(lines)
        before, after = lines[:, :-1], lines[:, 1:]
        jumps = (before > 0) & (after > 0)
        jumps &= np.abs(before - after) > 0.05 * np.maximum(before, after)
        ending = _runs(lines)[:, :-1][jumps]
        beginning = _runs(lines[:, ::-1])[:, ::-1][:, 1:][jumps]
        ending, beginning = ending[ending > 3], beginning[beginning > 3]
        for one, other in ((ending, beginning), (beginning, ending)):
            excess = len(one) - len(other)
            certain = excess > _SIGNIFICANT * (len(one) + len(other)) ** 0.5
            if certain and one.sum() > 2 * other.sum():
                most = max(most, float(one.sum() - other.sum()) / measured)
    return most


def _runs(lines: NDArray[np.float32]) -> NDArray[np.int32]:
    """How many pixels up to each one have its value."""
    places = np.arange(lines.shape[1], dtype=np.int32)
    begins = np.ones(lines.shape, np.bool_)
    begins[:, 1:] = lines[:, 1:] != lines[:, :-1]
    first = np.maximum.accumulate(np.where(begins, places, 0), axis=1)
    runs: NDArray[np.int32] = places - first + 1
    return runs


def shows_range(
    image: RangeImage, labels: NDArray[np.uint16], planes: Mapping[int, NDArray[np.float64]]
) -> bool:
    """Whether the planes are bent as those are whose range was taken for depth.

    Of a plane theta . ray = 1/z the range gives (theta . ray) / |ray|. Each plane tells its share
    of that bend, 0 for depth and 1 for range; the likelihoods of the two are compared, with the
    tails of Cauchy's distribution, as not everything that is labelled is flat.
    """
    if image.camera is None:
        return False
    step = max(round((labels.size / _SAMPLE) ** 0.5), 1)
    measured = image.inverse[::step, ::step].ravel()
    some = np.where(measured > 0, labels[::step, ::step].ravel(), 0)
    order = np.argsort(some, kind='stable')
    ends = np.searchsorted(some[order], (0, *planes), side='right')
    rays = image.rays[::step, ::step].reshape(-1, 3)
    odds = 0.0
    for first, after, theta in zip(ends[:-1], ends[1:], planes.values(), strict=True):
        if after - first > _FEWEST:
            seen = order[first:after]
            share, variance = _share_of_range(rays[seen].astype(float), measured[seen], theta)
            # Real planes differ by more than their noise tells.
            variance += _SPREAD**2
            odds += np.log1p(share**2 / variance) - np.log1p((share - 1) ** 2 / variance)
    return bool(odds > _ODDS)


def _share_of_range(
    rays: NDArray[np.float64], inverse: NDArray[np.float32], theta: NDArray[np.float64]
) -> tuple[float, float]:
    """Share of the bend in one plane, and its variance; what does not fit is left out."""
    bend = (rays @ theta) * (1 / np.sqrt(np.einsum('ij,ij->i', rays, rays)) - 1)
    terms = np.column_stack([rays, bend])
    kept = np.ones(len(rays), np.bool_)
    for _ in range(3):
        used = terms[kept]
        matrix = used.T @ used
        covariance = np.linalg.inv(matrix + 1e-12 * np.trace(matrix) * np.eye(4))
        solution = covariance @ (used.T @ inverse[kept])
        left = np.abs(inverse - terms @ solution)
        variance = np.mean(left[kept] ** 2) * covariance[3, 3]
        kept = left < 3 * 1.4826 * np.median(left) + 1e-9
    return float(solution[3]), float(variance)


def improbable_scale(image: RangeImage) -> float:
    """How many times too far a Kinect's image is read; 0 where nothing tells that it is.

    Its inverse depth has regular steps whose size is known. Half of them must be even within a
    tenth, and the mean fit a quotient of units within a twentieth.
    """
    some = image.inverse[::4, ::4]
    steps = np.diff(np.unique(some[some > 0]))
    if len(steps) < 20:
        return 0.0
    step = np.median(steps)
    if np.mean(np.abs(steps - step) < 0.1 * step) < 0.5:
        return 0.0
    for factor in _WRONG_UNITS:
        if abs(step * factor / _KINECT_STEP - 1) < 0.05:
            return factor
    return 0.0
