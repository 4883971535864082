"""How much of the residuals a field explains on frames it was not learned from.

The frames are cut into blocks of consecutive ones, as neighbours in time see almost the same. Each
block is left out once; what the field of the others does to its residuals decides how smooth the
field is, whether it depends on the distance, and by how much it is scaled down where little of it
holds. The fields of the blocks left out also tell the uncertainty (delete-a-group jackknife), to
which the difference to a less smooth field is added.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.calibration.bands import column_profile
from rangeseg_ros.core.calibration.field import residuals, robust_weights, solve
from rangeseg_ros.core.calibration.sightings import Sightings, cell_grid, cell_size

BLOCKS = 5
"""Parts of the recording that are left out in turn."""
# Tried from the smoothest on, in sightings of a cell, a factor of 4 apart.
_SMOOTHNESS = (64.0, 16.0, 4.0)
# Less of the residual that a second coefficient must leave: it doubles what is learned.
_WORTH = 0.9
# Cells over which the uncertainty is averaged: four degrees of freedom are few.
_AVERAGED = 2.0


class Fold(NamedTuple):
    """One block left out.

    Attributes
    ----------
    frames : (first, last) int
        The block.
    error : (K, G) float64
        Field of the other frames, with the bands, 1/m.
    before, after : float
        Root mean square residual of the cells of the block, without and with the field, 1/m.
    cells : int
        Number of these cells.
    projection : (float, float)
        Sums over these cells of residual times field's share, and of its square.
    """

    frames: tuple[int, int]
    error: NDArray[np.float64]
    before: float
    after: float
    cells: int
    projection: tuple[float, float]


class Learned(NamedTuple):
    """A field and what its validation says.

    Attributes
    ----------
    field : (K, G) float64
        Without the bands, 1/m: offset, and with K = 2 slope, of every cell.
    profile : (W,) float64
        Bands, 1/m.
    deviation : (G,) float64
        Standard deviation of the offset, 1/m.
    reference : float
        Inverse depth at which the offset holds, 1/m.
    smoothness : float
    gain : float
        By which the field was scaled down, 0...1.
    folds : list of Fold
    """

    field: NDArray[np.float64]
    profile: NDArray[np.float64]
    deviation: NDArray[np.float64]
    reference: float
    smoothness: float
    gain: float
    folds: list[Fold]


def learn(seen: Sightings, shape: tuple[int, int]) -> Learned:
    """Field of all frames, validated over time.

    Parameters
    ----------
    seen : Sightings
        Planes in at least `BLOCKS` frames.
    shape : (int, int)
        Of the images.
    """
    reference = float(np.median(seen.inverse))
    spread = max(float(seen.inverse.std()), 1e-6)
    # Of the planes, not of the measurements: a slope that is the same everywhere is then free, as
    # it only scales the planes, and cannot explain the noise away.
    slope = (seen.inverse - residuals(seen, seen.inverse) - reference) / spread
    one = np.ones((1, len(seen.inverse)))
    grid = cell_grid(shape)
    # Two rounds of weights: the first are those of residuals without any field.
    weight = robust_weights(seen, np.zeros(len(seen.inverse)))
    first = solve(seen, one, weight, grid, _SMOOTHNESS[-2])
    weight = robust_weights(seen, first[0, seen.cell])

    blocks = np.array_split(np.unique(seen.frame), BLOCKS)
    with ThreadPoolExecutor() as pool:
        tasks = [
            pool.submit(_folds, seen, one, weight, shape, (block[0], block[-1]), _SMOOTHNESS)
            for block in blocks
        ]
        found = [task.result() for task in tasks]
        totals = [_total([folds[i] for folds in found]) for i in range(len(_SMOOTHNESS))]
        best = int(np.argmin(totals))
        folds, basis = [folds[best] for folds in found], one
        two = np.stack([one[0], slope])
        smoothness = _SMOOTHNESS[best]
        tasks = [
            pool.submit(_folds, seen, two, weight, shape, (block[0], block[-1]), (smoothness,))
            for block in blocks
        ]
        sloped = [task.result()[0] for task in tasks]
    if _total(sloped) < _WORTH * totals[best]:
        folds, basis = sloped, two
    profile = column_profile(seen)
    banded = seen._replace(inverse=seen.inverse - _in_cells(profile, shape)[seen.cell])
    field = solve(banded, basis, weight, grid, smoothness)
    along, square = np.sum([fold.projection for fold in folds], axis=0)
    gain = float(np.clip(along / square, 0, 1)) if square > 0 else 0.0
    # What smoothing costs shows in a field that is less smooth.
    rougher = solve(banded, basis, weight, grid, smoothness / 4, field)
    bias = rougher[0] - field[0]
    deviation = gain * _deviation([fold.error[0] for fold in folds], bias, seen, grid)
    field[1:] /= spread
    return Learned(gain * field, gain * profile, deviation, reference, smoothness, gain, folds)


def _folds(
    seen: Sightings,
    basis: NDArray[np.float64],
    weight: NDArray[np.float64],
    shape: tuple[int, int],
    block: tuple[int, int],
    smoothness: tuple[float, ...],
) -> list[Fold]:
    """A `Fold` for each smoothness, of the frames from the first to the last of the block."""
    frames = np.arange(len(seen.jumps))
    outside = (frames < block[0]) | (frames > block[1])
    train, test = seen.of_frames(outside), seen.of_frames(~outside)
    out = outside[seen.frame][seen.plane()]
    bands = _in_cells(column_profile(train), shape)
    train = train._replace(inverse=train.inverse - bands[train.cell])
    before = residuals(test, test.inverse)
    field, result = None, []
    for value in smoothness:
        field = solve(train, basis[:, out], weight[out], cell_grid(shape), value, field)
        error = field.copy()
        error[0] += bands
        share = (basis[:, ~out] * error[:, test.cell]).sum(axis=0)
        share = residuals(test, share)
        squares = [float((part**2).mean()) for part in (before, before - share)]
        projection = float((before * share).sum()), float((share**2).sum())
        rms = np.sqrt(squares)
        result.append(Fold(block, error, rms[0], rms[1], len(before), projection))
    return result


def _total(folds: list[Fold]) -> float:
    """Root mean square residual of all blocks, with the field."""
    cells = np.array([fold.cells for fold in folds])
    squares = np.array([fold.after**2 for fold in folds])
    return float(np.sqrt((cells * squares).sum() / cells.sum()))


def _in_cells(profile: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Mean of a profile of columns (W,) over each cell, (G,)."""
    size, (rows, columns) = cell_size(shape), cell_grid(shape)
    padded = np.pad(profile, (0, columns * size - len(profile)), mode='edge')
    return np.tile(padded.reshape(columns, size).mean(axis=1), rows)


def _deviation(
    fields: list[NDArray[np.float64]],
    bias: NDArray[np.float64],
    seen: Sightings,
    grid: tuple[int, int],
) -> NDArray[np.float64]:
    """Standard deviation of a field from those without one block each, and from its bias."""
    known = np.bincount(seen.cell, minlength=grid[0] * grid[1]) > 0
    each = np.stack([without_plane(field.reshape(grid), known.reshape(grid)) for field in fields])
    variance = (len(fields) - 1) * each.var(axis=0)
    variance += without_plane(bias.reshape(grid), known.reshape(grid)) ** 2
    weight = known.reshape(grid).astype(np.float64)
    smooth = cv2.GaussianBlur(variance * weight, (0, 0), _AVERAGED)
    smooth /= np.maximum(cv2.GaussianBlur(weight, (0, 0), _AVERAGED), 1e-6)
    return np.sqrt(smooth).ravel() * known


def without_plane(field: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Field (H, W) less its least-squares plane a u + b v + c where it is known; 0 elsewhere."""
    v, u = np.nonzero(known)
    terms = np.stack([u, v, np.ones(len(u))], axis=1)
    plane, *_ = np.linalg.lstsq(terms, field[v, u], rcond=None)
    result = np.zeros_like(field)
    result[v, u] = field[v, u] - terms @ plane
    return result
