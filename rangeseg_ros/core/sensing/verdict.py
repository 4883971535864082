"""Whether an image is what it is taken for: enlarged, filled, range for depth, a wrong unit.

Each of these leaves exact traces in the image itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rangeseg_ros.core.arrays import Floats, Indices, Labels, Singles
from rangeseg_ros.core.sensing.enlargement import SIGNIFICANT, enlargement
from rangeseg_ros.core.sensing.range_image import FAR, NEAR, RangeImage
from rangeseg_ros.core.significance import OUTLIER, quantile

ODDS = float(np.log(1e4))
"""Logarithm of the odds at which one reading of an image is believed and not the other."""
SPREAD = 0.2
"""By which the bends of real planes differ, of that of planes whose values are misread."""
_FEWEST = 40  # pixels that tell the bend of a plane
_SAMPLE = 5000  # pixels that stand for an image
# Step of the inverse depth of a Kinect, 1/m: an eighth of a pixel at 580 px and 75 mm.
_KINECT_STEP = 1 / (8 * 580 * 0.075)
# Units that are confused: 1/1000 m with 1/5000 m, 1/10000 m and metres, and the reverse.
_WRONG_UNITS = (5.0, 0.2, 10.0, 0.1, 1000.0, 0.001)
# Reasons for which every metric result is wrong, not only less certain.
_INVALID = {
    'disparity instead of depth',
    'picture instead of depth',
    'range instead of z',
    'scale improbable',
    'millimetres in floats',
    'noise instead of depth',
}


class Verdict(NamedTuple):
    """What is doubtful about an image: reasons such as `filled 12 %`, and a sentence for each."""

    reasons: tuple[str, ...] = ()
    details: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether nothing speaks against the image."""
        return not self.reasons

    @property
    def invalid(self) -> bool:
        """Whether every metric result is wrong, not only less certain."""
        return not _INVALID.isdisjoint(self.reasons)

    def __str__(self) -> str:
        return ' '.join(self.details) or 'trusted'


def judge(
    image: RangeImage,
    labels: Labels,
    planes: Mapping[int, Floats],
    curved: Labels | None = None,
    identified: bool = True,
    values: str = 'depth',
) -> Verdict:
    """Look for what makes an image doubtful in which planes, label -> theta (3,), were found.

    `curved` (H, W) is not 0 on surfaces that are smooth and no planes; `identified` is False where
    the image was to tell the errors of the sensor and does not.
    """
    if not image.valid.any():
        return Verdict(('nothing measured',), ('Nothing in the image is measured.',))
    found = no_depth(image)
    unit_known = bool(found)
    if cells := enlargement(image):
        found[f'enlarged x {cells.factor}'] = (
            f'Each measurement fills {cells.factor} x {cells.factor} pixels: the image was '
            'enlarged; use the original.'
        )
    elif (share := filled_share(image)) > 0.01:
        found[f'filled {100 * share:.0f} %'] = (
            'Pixels beside edges copy their neighbours: holes were filled; switch that off.'
        )
    if values != 'depth':
        found[f'{values} instead of depth'] = (
            f'Surfaces are flat only if this is a {values}: it is segmented as such, in no unit.'
        )
    elif shows_range(image, labels, planes):
        found['range instead of z'] = (
            'Surfaces are flat only if the values are distances from the camera, not along its '
            'axis: multiply them by 1 / |ray|.'
        )
    if not unit_known and (factor := improbable_scale(image)):
        hint, times = ' (TUM: 0.0002)', f'{factor:g} times too far'
        if factor < 1:
            hint, times = '', f'{1 / factor:g} times too near'
        found['scale improbable'] = (
            f'The steps of the depth are those of a Kinect whose image is read {times}: '
            f'check the depth scale{hint}.'
        )
    # A range that is read as z bends all planes.
    if curved is None or 'range instead of z' in found:
        curved = np.zeros_like(labels)
    if np.count_nonzero(curved) > np.count_nonzero(labels):
        found['curved scene'] = (
            'More pixels are on curved surfaces than on planes: a part of the planes may be '
            'curved, too.'
        )
    if not identified:
        found['distortion not identifiable'] = (
            'Too little of the image is flat to measure noise and distortion: those of the '
            'parameters are used.'
        )
    return Verdict(tuple(found), tuple(found.values()))


def no_depth(image: RangeImage) -> dict[str, str]:
    """Why an image is no depth in metres at all, as far as that is quick to see."""
    rows, found = image.inverse[::16], dict[str, str]()
    both = (rows[:, 1:] > 0) & (rows[:, :-1] > 0)
    if not both.any():
        return found
    typical = float(np.median(rows[rows > 0]))
    if OUTLIER * np.abs(np.diff(rows)[both]).mean() > typical:
        found['noise instead of depth'] = 'Neighbouring pixels have nothing in common.'
    if typical < 1 / FAR:
        found['millimetres in floats'] = (
            f'Half of the image is beyond {FAR:.0f} m: the values are not in metres (of '
            'millimetres the scale is 0.001).'
        )
    if typical > 1 / NEAR:
        found['scale improbable'] = (
            f'Half of the image is nearer than {100 * NEAR:.0f} cm, which no depth camera '
            'measures: check the depth scale.'
        )
    return found


def filled_share(image: RangeImage) -> float:
    """Share of the pixels that copy a neighbour up to a jump.

    Filters that fill holes continue a pixel to their far side; of steps of the sensor, a jump cuts
    the last one short.
    """
    if image.camera is None:
        return 0.0
    most = 0.0
    for lines in (image.inverse[::4], image.inverse[:, ::4].T):
        measured = np.count_nonzero(lines)
        before, after = lines[:, :-1], lines[:, 1:]
        jumps = (before > 0) & (after > 0)
        jumps &= np.abs(before - after) > 0.05 * np.maximum(before, after)
        rows, columns = np.nonzero(jumps)
        for side, at in ((lines, columns), (lines[:, ::-1], lines.shape[1] - 2 - columns)):
            copies = _excess(side, rows * lines.shape[1] + at)
            if copies.sum() > SIGNIFICANT * (copies**2).sum() ** 0.5:
                most = max(most, float(copies.sum()) / measured)
    return most


def _excess(lines: Singles, at: Indices) -> Indices:
    """By how many pixels runs of a value up to those `at` (N,) exceed measured runs before."""
    begins = np.flatnonzero(np.diff(lines, axis=1, prepend=np.float32(-1)))
    last = np.searchsorted(begins, at, 'right') - 1
    here, there = begins[last], begins[last - 1]
    known = (here % lines.shape[1] > 0) & (lines.ravel()[here - 1] > 0)
    return np.asarray((at + 1 - 2 * here + there)[known])


def shows_range(image: RangeImage, labels: Labels, planes: Mapping[int, Floats]) -> bool:
    """Whether the planes are bent as those are whose range was taken for depth.

    Of a plane theta . ray = 1/z the range gives (theta . ray) / |ray|. Each plane tells its share
    of that bend, 0 for depth and 1 for range; Cauchy's distribution gives the likelihoods.
    """
    if image.camera is None:
        return False
    step = max(round((labels.size / _SAMPLE) ** 0.5), 1)
    inverse, labels = image.inverse[::step, ::step], labels[::step, ::step]
    odds = 0.0
    for label, theta in planes.items():
        seen = (labels == label) & (inverse > 0)
        if np.count_nonzero(seen) > _FEWEST:
            rays = image.rays[::step, ::step][seen].astype(float)
            share, variance = _share_of_range(rays, inverse[seen], theta)
            # Real planes differ by more than their noise tells.
            variance += SPREAD**2
            odds += np.log1p(share**2 / variance) - np.log1p((share - 1) ** 2 / variance)
    return bool(odds > ODDS)


def _share_of_range(rays: Floats, inverse: Singles, theta: Floats) -> tuple[float, float]:
    """Share of the bend in one plane, and its variance; what does not fit is left out."""
    bend = (rays @ theta) * (1 / np.linalg.norm(rays, axis=1) - 1)
    terms = np.column_stack([rays, bend])
    # Of pixels in a line the terms depend on each other, but for how rays are rounded.
    kept, rounding = np.ones(len(rays), np.bool_), np.finfo(np.float32).eps ** 2 * np.eye(4)
    for _ in range(2):
        square = terms[kept].T @ terms[kept]
        covariance = np.linalg.inv(square + np.trace(square) * rounding)
        solution = covariance @ (terms[kept].T @ inverse[kept])
        left = np.abs(inverse - terms @ solution)
        variance = np.mean(left[kept] ** 2) * covariance[3, 3]
        kept = left < 3 * 1.4826 * quantile(left, 0.5) + 1e-9
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
    fitting = (f for f in _WRONG_UNITS if abs(step * f / _KINECT_STEP - 1) < 0.05)
    return next(fitting, 0.0)
