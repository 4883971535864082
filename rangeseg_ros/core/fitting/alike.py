"""Sets of blocks that a sensor errs alike in, and quantiles of what they show."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

# Bins of the inverse range with enough blocks for a quantile each: the error of a quantile of 40
# blocks of 13 degrees of freedom is 7 % of a standard deviation.
_BINS, _SLOPES, _PER_BIN = 8, 3, 40
# Equal steps of a key that its values are counted by: few to a step, and all in cache.
_STEPS = 512


class Sets(NamedTuple):
    """Sets 0...S-1 of blocks alike in inverse range and slope.

    Attributes
    ----------
    order : (N,) int32
        Numbers of the blocks, set by set.
    start : (S + 1,) int
        Where each set begins in `order`.
    slopes : int
        Sets of a range, of which the first faces the sensor.
    """

    order: NDArray[np.int32]
    start: NDArray[np.intp]
    slopes: int


@njit(cache=True, nogil=True)
def alike(squared: NDArray[np.float64], slope: NDArray[np.float64]) -> Sets:
    """Sets of N blocks by their squared inverse range, and of a range by their slope (N,).

    Sets of a range are of the same size but for one block, and so are those of all ranges: what
    counts is who is in a set, and no set is sorted.
    """
    count = len(squared)
    slopes = _SLOPES if count >= _SLOPES * _PER_BIN else 1
    bins = min(_BINS, max(count // (slopes * _PER_BIN), 1))
    order = np.arange(count).astype(np.int32)
    ranges = _shares(0, count, bins)
    _divide(order, squared, squared, ranges)
    start = np.zeros(bins * slopes + 1, np.intp)
    for k in range(bins):
        parts = _shares(ranges[k], ranges[k + 1], slopes)
        _divide(order, slope, squared, parts)
        start[k * slopes : (k + 1) * slopes + 1] = parts
    return Sets(order, start, slopes)


@njit(cache=True)
def _shares(first: int, after: int, count: int) -> NDArray[np.intp]:
    """Bounds (count + 1,) of equal shares, the first ones larger by one where they must be."""
    size, more = (after - first) // count, (after - first) % count
    return np.array([first + k * size + min(k, more) for k in range(count + 1)])


@njit(cache=True)
def _divide(
    order: NDArray[np.int32],
    key: NDArray[np.float64],
    second: NDArray[np.float64],
    bounds: NDArray[np.intp],
) -> None:
    """Permute `order` so that keys rise from each share to the next.

    Of equal keys, as slopes of 0 are, the `second` ones rise, then the numbers. Counted by equal
    steps of the key first (bucket sort), so that only those of the steps that bounds fall into are
    compared.
    """
    first, after = bounds[0], bounds[-1]
    old, step = order[first:after].copy(), np.empty(after - first, np.int32)
    keys = key[old]
    least = keys.min() if len(old) > 0 else 0.0
    most = keys.max() if len(old) > 0 else 0.0
    scale = (_STEPS - 1) / max(most - least, 1e-300)
    start = np.zeros(_STEPS + 1, np.int32)
    for k in range(len(old)):
        steps = (keys[k] - least) * scale
        step[k] = np.int32(steps) if steps < _STEPS else _STEPS - 1
        start[step[k] + 1] += 1
    for k in range(_STEPS):
        start[k + 1] += start[k]
    place = start.copy()
    for k in range(len(old)):
        order[first + place[step[k]]] = old[k]
        place[step[k]] += 1
    low, here = first, 0
    for bound in bounds[1:-1]:
        while here < _STEPS - 1 and first + start[here + 1] <= bound:
            here += 1
        low = max(low, first + start[here])
        _place(order, key, second, (low, first + start[here + 1]), bound)
        low = bound


@njit(cache=True)
def _place(
    order: NDArray[np.int32],
    key: NDArray[np.float64],
    second: NDArray[np.float64],
    within: tuple[int, int],
    place: int,
) -> None:
    """Permute a part of `order` so that what comes to `place` is what sorting would bring there.

    What precedes it is before it, and what it precedes is behind it (quickselect; Hoare 1961).
    """
    low, high = within[0], within[1] - 1
    while low < high:
        pivot = order[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while _precedes(order[i], pivot, key, second):
                i += 1
            while _precedes(pivot, order[j], key, second):
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if place <= j:
            high = j
        elif place >= i:
            low = i
        else:
            break


@njit(cache=True)
def _precedes(a: int, b: int, key: NDArray[np.float64], second: NDArray[np.float64]) -> bool:
    if key[a] != key[b]:
        return key[a] < key[b]
    if second[a] != second[b]:
        return second[a] < second[b]
    return a < b


@njit(cache=True, nogil=True)
def quantiles(values: NDArray[np.float64], sets: Sets, quantile: float) -> NDArray[np.float64]:
    """Quantile (S,) of the values (N,) of the blocks of each set."""
    result = np.empty(len(sets.start) - 1)
    for k in range(len(result)):
        result[k] = ranked(values[sets.order[sets.start[k] : sets.start[k + 1]]], quantile)
    return result


@njit(cache=True)
def ranked(values: NDArray[np.float64], quantile: float) -> float:
    """One of N values that so many lie below; permutes them."""
    return _ranked(values, int(quantile * (len(values) - 1)))


@njit(cache=True, nogil=True)
def median(values: NDArray[np.float64]) -> float:
    """Median of N values."""
    values = values.copy()
    count = len(values)
    upper = _ranked(values, count // 2)
    if count % 2 == 1:
        return upper
    return (values[: count // 2].max() + upper) / 2


@njit(cache=True)
def _ranked(values: NDArray[np.float64], rank: int) -> float:
    """What sorting would bring to a rank; it comes there, and none before it is larger.

    What np.partition does, which numba takes as long to compile as the rest of the noise. Parts
    are swapped without branches (Lomuto's scheme), which no processor foretells in noise.
    """
    low, high = 0, len(values) - 1
    while low < high:
        # The median of three, as values that rise and fall would take the middle one N rounds.
        a, b, c = values[low], values[(low + high) // 2], values[high]
        pivot = max(min(a, b), min(max(a, b), c))
        below = low
        for k in range(low, high + 1):
            value = values[k]
            values[k], values[below] = values[below], value
            below += value < pivot
        if rank < below:
            high = below - 1
            continue
        # Those as large as the pivot: itself at least.
        same = below
        for k in range(below, high + 1):
            value = values[k]
            values[k], values[same] = values[same], value
            same += value == pivot
        if rank < same:
            break
        low = max(same, below + 1)
    return float(values[rank])
