"""From the sightings of a recording to the distortion map, or to what the recording lacks.

The recording is cut into blocks of consecutive frames, as neighbours in time see almost the same.
Each block is left out once, and the field of the others tried on it: that decides how smooth the
field is and whether it depends on the distance (cross-validation), tells how much of the residual
it explains, and how uncertain it is (delete-a-group jackknife).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from rangeseg_ros.core.arrays import Floats, Indices, Mask
from rangeseg_ros.core.calibration.field import residuals, robust_weights, solve
from rangeseg_ros.core.calibration.sightings import Sightings, cell_grid, cell_size
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.distortion import DistortionMap, in_pixels

BLOCKS = 5
"""Parts of the recording that are left out in turn."""
# Each block that is left out has two frames at least.
_FEWEST_FRAMES = 2 * BLOCKS
# Inverse depths that count as different views of a cell differ by this part; and the views that
# most cells need, one more than the two coefficients of a cell: what one surface shows in one
# place may be its own shape.
_VIEW, _FEWEST_VIEWS = 0.1, 3
# Smoothness that is tried, in sightings of a cell: with each step, waves that are shorter by a
# factor of 1.7 are kept. A slope is known worse, as distances differ little.
_STEP = 8.0
_SMOOTHNESS = ((4096.0,), (512.0,), (64.0,), (8.0,))
_SLOPES = (512.0, 64.0)
# Cells over which the uncertainty is averaged: that of one cell has four degrees of freedom only,
# and a value that is low by chance would be trusted most.
_AVERAGED = 5.0
ADVICE = (
    'record walls, floor and other flat things for half a minute while the camera moves slowly: '
    'nearer and farther, turned in all directions, so that flat surfaces cross every part of the '
    'image at several distances'
)


class CalibrationError(ValueError):
    """A recording from which the distortion cannot be learned."""


class Fold(NamedTuple):
    """One block of frames, first and last, left out, and the field (K, G) of the others, 1/m.

    Root mean square residual of the cells of the block, without and with the field, 1/m, and the
    sum of the weights of these cells.
    """

    frames: tuple[int, int]
    field: Floats
    before: float
    after: float
    weight: float


_Block = tuple[Mask, Floats]


class Calibration(NamedTuple):
    """What was learned.

    `views` (rows, columns) are the different distances at which each cell was seen; `before` is
    the root mean square residual of the cells of planes, 1/m, `after` that on frames left out,
    with the map of the others.
    """

    distortion: DistortionMap
    views: Indices
    folds: list[Fold]
    before: float
    after: float


def calibrate(
    seen: Sightings, shape: tuple[int, int], camera: Camera | None = None
) -> Calibration:
    """Learn the distortion of a sensor from sightings in images of a shape, in the order of time.

    CalibrationError where the recording does not hold it; the message says what to record.
    """
    views = _views(seen, shape)
    _check(seen, views)
    grid, reference = cell_grid(shape), float(np.median(seen.inverse))
    # By the planes, not by the measurements: a slope that is the same everywhere only scales the
    # planes, so that it is free and cannot explain the noise away.
    change = seen.inverse - residuals(seen, seen.inverse) - reference
    spread = max(float(np.median(np.abs(change))), 1e-6)
    basis = np.stack([np.ones(len(change)), change / spread])
    blocks = _blocks(seen, grid)

    def best(tried: Sequence[tuple[float, ...]]) -> tuple[tuple[float, ...], list[Fold]]:
        folds = [_folds(seen, basis[: len(own)], blocks, grid, own) for own in tried]
        return min(zip(tried, folds, strict=True), key=lambda pair: _left(pair[1]).sum())

    smoothness, folds = best(_SMOOTHNESS)
    sloped = best([(*smoothness, slope) for slope in _SLOPES])
    # The simpler model, unless the other is better by more than the standard error of that.
    gain = _left(folds) - _left(sloped[1])
    if gain.mean() > gain.std(ddof=1) / np.sqrt(BLOCKS):
        smoothness, folds = sloped
    weight = _settled_weights(seen, grid)
    # What smoothing costs shows in a field that is less smooth.
    field, rough = (
        solve(seen, basis[: len(smoothness)], weight, grid, [s / less for s in smoothness])
        for less in (1, _STEP)
    )
    known, flat = views > 0, field[0].reshape(grid)
    each = [fold.field[0].reshape(grid) for fold in folds]
    deviation = _deviation(each, rough[0].reshape(grid) - flat, known)
    size = cell_size(shape)
    pixels = np.kron(known, np.ones((size, size), np.bool_))[: shape[0], : shape[1]]
    slope = None
    if len(field) > 1:
        sloping = pixels * in_pixels(field[1].reshape(grid) / spread, size, shape)
        # One slope everywhere scales all planes, and leaves them planes.
        slope = (sloping - pixels * sloping[pixels].mean()).astype(np.float32)
    distortion = DistortionMap(
        without_plane(in_pixels(flat, size, shape), pixels).astype(np.float32),
        (pixels * in_pixels(deviation, size, shape)).astype(np.float32),
        slope,
        camera,
        0.0 if slope is None else reference,
    )
    squares = np.square([(fold.before, fold.after) for fold in folds])
    mean = np.sqrt(np.average(squares, axis=0, weights=[fold.weight for fold in folds]))
    return Calibration(distortion, views, folds, float(mean[0]), float(mean[1]))


def _views(seen: Sightings, shape: tuple[int, int]) -> Indices:
    """Number of different distances at which each cell was seen."""
    rows, columns = cell_grid(shape)
    level = np.floor(np.log(np.maximum(seen.inverse, 1e-6)) / np.log1p(_VIEW)).astype(np.intp)
    pairs = np.unique(np.stack([seen.cell, level]), axis=1)
    return np.bincount(pairs[0], minlength=rows * columns).reshape(rows, columns)


def _check(seen: Sightings, views: Indices) -> None:
    frames, covered = len(np.unique(seen.frame)), float((views > 0).mean())
    why = ''
    if frames < _FEWEST_FRAMES:
        why = (
            f'too few planes: {frames} of {seen.frames} frames show one that is large enough, '
            f'{_FEWEST_FRAMES} are needed'
        )
    elif covered < 0.5:
        why = f'too few positions: planes cover {covered:.0%} of the image, half of it is needed'
    elif (typical := int(np.median(views[views > 0]))) < _FEWEST_VIEWS:
        why = (
            f'too few ranges: most parts of the image see planes at no more than {typical} of the '
            f'{_FEWEST_VIEWS} distances that tell the sensor from the shape of things'
        )
    if why:
        raise CalibrationError(f'{why}; {ADVICE}')


def _settled_weights(seen: Sightings, grid: tuple[int, int]) -> Floats:
    """Weights (N,) by the residuals of a field that was solved with weights by no field."""
    weight = robust_weights(seen, 0.0)
    (field,) = solve(seen, np.ones((1, len(weight))), weight, grid, _SMOOTHNESS[1])
    return robust_weights(seen, field[seen.cell])


def _blocks(seen: Sightings, grid: tuple[int, int]) -> list[_Block]:
    """Which planes (P,) are of each block of frames, and weights of the cells of all others."""
    found = []
    for block in np.array_split(np.unique(seen.frame), BLOCKS):
        inside = (seen.frame >= block[0]) & (seen.frame <= block[-1])
        found.append((inside, _settled_weights(seen.of_planes(~inside), grid)))
    return found


def _folds(
    seen: Sightings,
    basis: Floats,
    blocks: Sequence[_Block],
    grid: tuple[int, int],
    smoothness: Sequence[float],
) -> list[Fold]:
    """The blocks of frames, each left out."""
    found = []
    for inside, weight in blocks:
        out = ~inside[seen.plane()]
        test = seen.of_planes(inside)
        field = solve(seen.of_planes(~inside), basis[:, out], weight, grid, smoothness)
        before, counts = residuals(test, test.inverse), robust_weights(test, 0.0)
        after = before - residuals(test, (basis[:, ~out] * field[:, test.cell]).sum(axis=0))
        rms = [float(np.sqrt(np.average(part**2, weights=counts))) for part in (before, after)]
        ends = int(test.frame.min()), int(test.frame.max())
        found.append(Fold(ends, field, rms[0], rms[1], float(counts.sum())))
    return found


def _left(folds: Sequence[Fold]) -> Floats:
    """Sums of the squares of what the fields leave of the residuals of each block."""
    return np.array([fold.weight * fold.after**2 for fold in folds])


def _deviation(fields: Sequence[Floats], bias: Floats, known: Mask) -> Floats:
    """Standard deviation of a field from those without one block each, and from its bias."""
    each = np.stack([without_plane(field, known) for field in fields])
    variance = (len(fields) - 1) * each.var(axis=0) + without_plane(bias, known) ** 2
    weight = known.astype(np.float64)
    smooth = cv2.GaussianBlur(variance * weight, (0, 0), _AVERAGED)
    smooth = smooth / np.maximum(cv2.GaussianBlur(weight, (0, 0), _AVERAGED), 1e-6)
    return np.asarray(np.sqrt(smooth) * known)


def without_plane(field: Floats, known: Mask) -> Floats:
    """Field (H, W) less its least-squares plane a u + b v + c where it is known; 0 elsewhere."""
    v, u = np.nonzero(known)
    terms = np.stack([u, v, np.ones(len(u))], axis=1)
    plane, *_ = np.linalg.lstsq(terms, field[v, u], rcond=None)
    result = np.zeros_like(field)
    result[v, u] = field[v, u] - terms @ plane
    return result
