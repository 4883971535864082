"""How much of the residuals a field explains on frames it was not learned from.

The frames are cut into blocks of consecutive ones, as neighbours in time see almost the same. Each
block is left out once, and the field of the others, which is almost that of all frames, is tried
on it. This decides how smooth the field is, and whether it depends on the distance, and tells
how much of the residual is explained, by how much the field is scaled down where little of it
holds, and its uncertainty (delete-a-group jackknife, to which the difference to a less smooth
field is added).

Cells count by robust weights, as in the solution: a few wrong regions would outvote the field.
Each field has weights of its own: with those of all frames a block that is left out has its say,
and the fields differ by a quarter less than they should.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.calibration.bands import column_profile
from rangeseg_ros.core.calibration.field import residuals, robust_weights, solve
from rangeseg_ros.core.calibration.sightings import Sightings, cell_grid, cell_size

BLOCKS = 5
"""Parts of the recording that are left out in turn."""
# Tried from the smoothest on, in sightings of a cell; with each step, waves that are shorter by a
# factor of 1.7 are kept.
_STEP = 8.0
_SMOOTHNESS = (4096.0, 512.0, 64.0, 8.0)
# Of the slope, which is known worse, as distances differ little.
_SLOPES = (512.0, 64.0)
# Part of the variance left by a field fixed in inverse depth that a slope must take away. On
# sensors simulated without such an error it takes 0.0004 at most, on those with one, and on a
# Kinect, 0.03 to 0.12.
_WORTH = 0.01
# Cells over which the uncertainty is averaged: of four degrees of freedom much is chance, and what
# is low by chance would be trusted most.
_AVERAGED = 5.0


class Fold(NamedTuple):
    """One block left out.

    Attributes
    ----------
    frames : (first, last) int
        The block.
    field : (K, G) float64
        Of the other frames, without the bands, 1/m.
    bands : (G,) float64
        Of the other frames, 1/m.
    before, after : float
        Root mean square residual of the cells of the block, without and with the field, 1/m.
    weight : float
        Sum of the weights of these cells.
    projection : (float, float)
        Sums over these cells of residual times field's share, and of its square.
    """

    frames: tuple[int, int]
    field: NDArray[np.float64]
    bands: NDArray[np.float64]
    before: float
    after: float
    weight: float
    projection: tuple[float, float]


class Learned(NamedTuple):
    """A field and what its validation says.

    Attributes
    ----------
    field : (K, G) float64
        Without the bands, 1/m: offset at `reference`, and with K = 2 slope, of every cell.
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
    change = (seen.inverse - residuals(seen, seen.inverse) - reference) / spread
    one, square = np.ones(len(change)), (1 + spread / reference * change) ** 2
    splits, grid = _splits(seen, shape), cell_grid(shape)

    def best(
        basis: NDArray[np.float64], linear: ArrayLike, tried: Sequence[tuple[float, ...]]
    ) -> _Model:
        found = [_folds(split, basis, grid, tried) for split in splits]
        pairs = zip(tried, map(list, zip(*found, strict=True)), strict=True)
        smoothness, folds = min(pairs, key=lambda pair: _left(pair[1]))
        return _Model(basis, np.array(linear), smoothness, folds)

    alone = [(value,) for value in _SMOOTHNESS]
    model = best(one[None], [[1.0]], alone)
    least = (1 - _WORTH) * _left(model.folds)
    # An error dr of the range is one of -y^2 dr of the inverse depth y: its tangent, as a line
    # through what was seen would follow the few nearest planes. Else a slope of its own.
    ranged = best(square[None], [[1.0], [2 / reference]], alone)
    slopes = [(*model.smoothness, value) for value in _SLOPES]
    sloped = best(np.stack([one, change]), np.diag([1.0, 1 / spread]), slopes)
    other = min(ranged, sloped, key=lambda each: _left(each.folds))
    if _left(other.folds) < least:
        model = other
    basis, linear, smoothness, folds = model
    weight, _ = _settled_weights(seen, grid)
    profile = column_profile(seen)
    banded = seen._replace(inverse=seen.inverse - _in_cells(profile, shape)[seen.cell])
    field = solve(banded, basis, weight, grid, smoothness)
    gain = _gain([fold.projection for fold in folds])
    # What smoothing costs shows in a field that is less smooth.
    less = [value / _STEP for value in smoothness]
    rough = solve(banded, basis, weight, grid, less, field)
    offset, change = linear[0] @ field, linear[0] @ (rough - field)
    # What was scaled off may be true.
    biases = [gain * change, (1 - gain) * offset]
    others = [gain * (linear[0] @ fold.field + fold.bands) for fold in folds]
    deviation = _deviation(others, biases, seen, grid)
    field = gain * linear @ field
    return Learned(field, gain * profile, deviation, reference, smoothness, gain, folds)


class _Model(NamedTuple):
    """A field of K coefficients for the factors `basis` (K, N), and how well it holds.

    `linear` turns them into the offset at the reference and, where there is one, the slope.
    """

    basis: NDArray[np.float64]
    linear: NDArray[np.float64]
    smoothness: tuple[float, ...]
    folds: list[Fold]


class _Split(NamedTuple):
    """A block of frames, and all others.

    Attributes
    ----------
    block : (first, last) int
    out : (N,) bool
        Cells of the others.
    train, test : Sightings
        The others, without their bands, and the block.
    weight, counts : (number of cells of train, of test) float64
        Weights for the solution, and in sums of squares.
    bands : (G,) float64
        Of the others, 1/m.
    """

    block: tuple[int, int]
    out: NDArray[np.bool_]
    train: Sightings
    test: Sightings
    weight: NDArray[np.float64]
    counts: NDArray[np.float64]
    bands: NDArray[np.float64]


def _splits(seen: Sightings, shape: tuple[int, int]) -> list[_Split]:
    """Each block of frames, and the others."""

    def split(block: NDArray[np.intp]) -> _Split:
        frames = np.arange(len(seen.jumps))
        outside = (frames < block[0]) | (frames > block[-1])
        train, test = seen.of_frames(outside), seen.of_frames(~outside)
        weight, first = _settled_weights(train, cell_grid(shape))
        bands = _in_cells(column_profile(train), shape)
        train = train._replace(inverse=train.inverse - bands[train.cell])
        ends, out = (int(block[0]), int(block[-1])), outside[seen.frame][seen.plane()]
        counts = robust_weights(test, first[test.cell])
        return _Split(ends, out, train, test, weight, counts, bands)

    return [split(block) for block in np.array_split(np.unique(seen.frame), BLOCKS)]


def _settled_weights(
    seen: Sightings, grid: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights (N,) by what a field leaves whose own weights know of none, and that field (G,)."""
    weight = robust_weights(seen, np.zeros(len(seen.inverse)))
    (field,) = solve(seen, np.ones((1, len(weight))), weight, grid, _SMOOTHNESS[1:2])
    return robust_weights(seen, field[seen.cell]), field


def _folds(
    split: _Split,
    basis: NDArray[np.float64],
    grid: tuple[int, int],
    tried: Sequence[Sequence[float]],
) -> list[Fold]:
    """A `Fold` for each smoothness."""
    block, out, train, test, weight, counts, bands = split
    before, total = residuals(test, test.inverse), float(counts.sum())
    field, result = None, []
    for smoothness in tried:
        field = solve(train, basis[:, out], weight, grid, smoothness, field)
        error = bands[test.cell] + (basis[:, ~out] * field[:, test.cell]).sum(axis=0)
        share = residuals(test, error)
        squares = [float(counts @ part**2) for part in (before, before - share)]
        projection = float(counts @ (before * share)), float(counts @ share**2)
        rms = np.sqrt(np.array(squares) / total)
        result.append(Fold(block, field, bands, rms[0], rms[1], total, projection))
    return result


def _left(folds: list[Fold]) -> float:
    """Sum of the squares of what the fields leave of the residuals of all blocks."""
    return sum(fold.weight * fold.after**2 for fold in folds)


def root_mean_square(parts: list[tuple[float, float]]) -> float:
    """Of parts with a weight and a root mean square each."""
    weight, value = np.array(parts, np.float64).T
    return float(np.sqrt((weight * value**2).sum() / weight.sum()))


def _gain(projections: list[tuple[float, float]]) -> float:
    """Share 0...1 of a field that is kept: what of it held, less what of that may be chance.

    The ratio of the sums of `projection`, with the factor 1 - (standard error / ratio)^2 (James
    and Stein 1961): little of a field that is known well, and most of one that is none.
    """
    along, square = np.array(projections).T
    if along.sum() <= 0 or square.sum() <= 0:
        return 0.0
    ratio = along.sum() / square.sum()
    variance = ((along - ratio * square) ** 2).sum() / square.sum() ** 2
    variance *= len(along) / (len(along) - 1)
    return float(np.clip(ratio - variance / ratio, 0, 1))


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
    smooth = smooth / np.maximum(cv2.GaussianBlur(weight, (0, 0), _AVERAGED), 1e-6)
    return np.sqrt(smooth).ravel() * known


def without_plane(field: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Field (H, W) less its least-squares plane a u + b v + c where it is known; 0 elsewhere."""
    v, u = np.nonzero(known)
    terms = np.stack([u, v, np.ones(len(u))], axis=1)
    plane, *_ = np.linalg.lstsq(terms, field[v, u], rcond=None)
    result = np.zeros_like(field)
    result[v, u] = field[v, u] - terms @ plane
    return result
