"""How much of the residuals a field explains on frames it was not learned from.

The frames are cut into blocks of consecutive ones, as neighbours in time see almost the same. Each
block is left out once, and the field of the others is tried on it. With two blocks, of which each
sees much that the other does not, this decides how smooth the field is, and whether it depends on
the distance. With more blocks, whose fields are almost that of all frames, it tells how much of
the residual is explained, by how much the field is scaled down where little of it holds, and its
uncertainty (delete-a-group jackknife, to which the difference to a less smooth field is added).

Cells count by their weights, as in the solution: a few wrong regions would outvote the field.
"""

from __future__ import annotations

from collections.abc import Sequence
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
# Times the variance explained that a second coefficient must explain. Sensors without it stay
# below 1.00 and a Kinect below 1.15; with it, readers of page 1 alone are left without a map.
_WORTH = 1.2
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
    weight : float
        Sum of the weights of these cells.
    projection : (float, float)
        Sums over these cells of residual times field's share, and of its square.
    """

    frames: tuple[int, int]
    error: NDArray[np.float64]
    before: float
    after: float
    weight: float
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
    smoothness : tuple of K float
    gain : float
        By which the field was scaled down, 0...1.
    folds : list of Fold
    """

    field: NDArray[np.float64]
    profile: NDArray[np.float64]
    deviation: NDArray[np.float64]
    reference: float
    smoothness: tuple[float, ...]
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
    spread = max(1.4826 * float(np.median(np.abs(seen.inverse - reference))), 1e-6)
    # Of the planes, not of the measurements: a slope that is the same everywhere is then free, as
    # it only scales the planes, and cannot explain the noise away.
    slope = (seen.inverse - residuals(seen, seen.inverse) - reference) / spread
    one = np.ones((1, len(seen.inverse)))
    grid = cell_grid(shape)
    # Two rounds of weights: the first are those of residuals without any field.
    weight = robust_weights(seen, np.zeros(len(seen.inverse)))
    first = solve(seen, one, weight, grid, _SMOOTHNESS[1:2])
    weight = robust_weights(seen, first[0, seen.cell])

    # Of two halves each sees much that the other does not, as later recordings will.
    tried: list[tuple[float, ...]] = [(value,) for value in _SMOOTHNESS]
    explained = [_explained(folds) for folds in _leave_out(seen, one, weight, shape, 2, tried)]
    basis, smoothness = one, tried[int(np.argmax(explained))]
    two, least = np.stack([one[0], slope]), _WORTH * max(*explained, 0.0)
    # The second coefficient is known worse, as distances differ little.
    tried = [(*smoothness, smoothness[0] * factor) for factor in _SMOOTHNESS]
    explained = [_explained(folds) for folds in _leave_out(seen, two, weight, shape, 2, tried)]
    if max(explained) > least:
        basis, smoothness = two, tried[int(np.argmax(explained))]
    (folds,) = _leave_out(seen, basis, weight, shape, BLOCKS, [smoothness])
    profile = column_profile(seen)
    banded = seen._replace(inverse=seen.inverse - _in_cells(profile, shape)[seen.cell])
    field = solve(banded, basis, weight, grid, smoothness)
    along, square = np.sum([fold.projection for fold in folds], axis=0)
    gain = float(np.clip(along / square, 0, 1)) if square > 0 else 0.0
    # What smoothing costs shows in a field that is less smooth.
    rougher = solve(banded, basis, weight, grid, [value / 4 for value in smoothness], field)
    # What was scaled off may be true.
    biases = [gain * (rougher[0] - field[0]), (1 - gain) * field[0]]
    deviation = _deviation([gain * fold.error[0] for fold in folds], biases, seen, grid)
    field[1:] /= spread
    return Learned(gain * field, gain * profile, deviation, reference, smoothness, gain, folds)


def _leave_out(
    seen: Sightings,
    basis: NDArray[np.float64],
    weight: NDArray[np.float64],
    shape: tuple[int, int],
    count: int,
    tried: Sequence[Sequence[float]],
) -> list[list[Fold]]:
    """For each smoothness that is tried, a `Fold` of each of `count` blocks of frames."""
    blocks = [
        (int(block[0]), int(block[-1])) for block in np.array_split(np.unique(seen.frame), count)
    ]
    with ThreadPoolExecutor() as pool:
        tasks = [pool.submit(_folds, seen, basis, weight, shape, block, tried) for block in blocks]
        found = [task.result() for task in tasks]
    return [list(folds) for folds in zip(*found, strict=True)]


def _folds(
    seen: Sightings,
    basis: NDArray[np.float64],
    weight: NDArray[np.float64],
    shape: tuple[int, int],
    block: tuple[int, int],
    tried: Sequence[Sequence[float]],
) -> list[Fold]:
    """A `Fold` for each smoothness, of the frames from the first to the last of the block."""
    frames = np.arange(len(seen.jumps))
    outside = (frames < block[0]) | (frames > block[1])
    train, test = seen.of_frames(outside), seen.of_frames(~outside)
    out = outside[seen.frame][seen.plane()]
    bands = _in_cells(column_profile(train), shape)
    train = train._replace(inverse=train.inverse - bands[train.cell])
    before, counts = residuals(test, test.inverse), weight[~out]
    field, result = None, []
    for smoothness in tried:
        field = solve(train, basis[:, out], weight[out], cell_grid(shape), smoothness, field)
        error = field.copy()
        error[0] += bands
        share = residuals(test, (basis[:, ~out] * error[:, test.cell]).sum(axis=0))
        squares = [float(counts @ part**2) for part in (before, before - share)]
        projection = float(counts @ (before * share)), float(counts @ share**2)
        total = float(counts.sum())
        rms = np.sqrt(np.array(squares) / total)
        result.append(Fold(block, error, rms[0], rms[1], total, projection))
    return result


def _explained(folds: list[Fold]) -> float:
    """Sum of the squares that the field takes away from the residuals of all blocks."""
    return sum(fold.weight * (fold.before**2 - fold.after**2) for fold in folds)


def root_mean_square(parts: list[tuple[float, float]]) -> float:
    """Of parts with a weight and a root mean square each."""
    weight, value = np.array(parts, np.float64).T
    return float(np.sqrt((weight * value**2).sum() / weight.sum()))


def _in_cells(profile: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Mean of a profile of columns (W,) over each cell, (G,)."""
    size, (rows, columns) = cell_size(shape), cell_grid(shape)
    padded = np.pad(profile, (0, columns * size - len(profile)), mode='edge')
    return np.tile(padded.reshape(columns, size).mean(axis=1), rows)


def _deviation(
    fields: list[NDArray[np.float64]],
    biases: list[NDArray[np.float64]],
    seen: Sightings,
    grid: tuple[int, int],
) -> NDArray[np.float64]:
    """Standard deviation of a field from those without one block each, and from its biases."""
    known = np.bincount(seen.cell, minlength=grid[0] * grid[1]) > 0
    each = np.stack([without_plane(field.reshape(grid), known.reshape(grid)) for field in fields])
    variance = (len(fields) - 1) * each.var(axis=0)
    for bias in biases:
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
