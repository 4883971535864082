"""Stairs up and down: level surfaces that follow each other at the same rise and run.

The treads in sight are heights above the ground that many level points have. The gradient of the
height over them is the direction of the stairs, and their noses, the edges that the robot sees,
lie one run apart along it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.meaning.cells import axes_of
from rangeseg_ros.core.meaning.classes import GROUND
from rangeseg_ros.core.meaning.ground import Terrain
from rangeseg_ros.core.sensing.range_image import RangeImage

# Rise and run of stairs, metres: what people climb, with a margin (ISO 21542 asks for 0.15 to 0.18
# and 0.26 to 0.30).
_RISE, _RUN = (0.08, 0.25), (0.2, 0.42)
# Narrowest staircase, metres.
_NARROWEST = 0.4
# Largest relative difference between the rises, and the runs, of one staircase.
_UNEVEN = 0.3
# Parts of one tread differ in height by less, metres: half of the least rise.
_LEVEL = 0.04
# Quantile of the points of a tread at its nose, which noise blurs.
_NOSE = 0.03
# Points of a tread: of every other pixel along columns and rows.
_FEWEST, _STRIDE = 20, 2
# How many of these points apart heights are compared, and the tangent up to which that is level.
_BESIDE, _STEEPEST = (1, 2), 0.25
# How many times more points a tread has at its height than half a rise below.
_CLEAR = 2.0
# The histogram of heights: width of a bin, and its end, metres.
_BIN, _HIGHEST = 0.01, 2.5


@dataclass(frozen=True, eq=False)
class Stairs:
    """A staircase.

    Attributes
    ----------
    edge : (2, 3) float64
        Ends of the first edge, as far as it is in sight, on the ground: the foot of the first
        riser, or the edge that the stairs go down from. Metres, in the frame of the image.
    width : float
        Length of the edge, metres.
    count : int
        Treads in sight.
    rise, run : float
        Of a tread, metres.
    direction : {'up', 'down'}
    """

    edge: NDArray[np.float64]
    width: float
    count: int
    rise: float
    run: float
    direction: str

    def __str__(self) -> str:
        """Such as: up 4 x 0.17 / 0.28 m."""
        return f'{self.direction} {self.count} x {self.rise:.2f} / {self.run:.2f} m'


class _Level(NamedTuple):
    """Points of level surfaces: heights above the ground, and places on two horizontal axes."""

    height: NDArray[np.float64]
    place: NDArray[np.float64]


def stairs_of(image: RangeImage, terrain: Terrain) -> list[Stairs]:
    """Staircases in sight: none or one up, none or one down.

    Parameters
    ----------
    image : RangeImage
        (H, W).
    terrain : Terrain
        The ground of the image.
    """
    if not terrain.stand.surface:
        return []
    points = _level_points(image, terrain)
    found = []
    for sign in (1, -1):
        levels = _levels(sign * points.height)
        if sign > 0:  # nobody sees a tread from below
            levels = levels[levels < terrain.stand.height(terrain.field.up)]
        if len(levels) > 1 and (stairs := _staircase(points, sign * levels, terrain)):
            found.append(stairs)
    return found


def _level_points(image: RangeImage, terrain: Terrain) -> _Level:
    """Every other pixel, along columns and rows, whose neighbours along up are as high."""
    up = terrain.field.up
    height = terrain.height[::_STRIDE, ::_STRIDE].astype(np.float64)
    inverse = image.inverse[::_STRIDE, ::_STRIDE].astype(np.float64)
    with np.errstate(divide='ignore', invalid='ignore'):
        place = image.rays[::_STRIDE, ::_STRIDE] @ axes_of(up)[1:].T / inverse[..., None]
    off_ground = terrain.classes[::_STRIDE, ::_STRIDE] > GROUND
    if abs(up[0]) > abs(up[1]):  # a camera on its side
        height, place, off_ground = height.T, place.transpose(1, 0, 2), off_ground.T
    level = np.zeros(height.shape, np.bool_)
    for k in _BESIDE:
        with np.errstate(invalid='ignore'):
            way = np.linalg.norm(place[: -2 * k] - place[2 * k :], axis=-1)
        # Also false where one of the two is not measured.
        level[k:-k] |= np.abs(height[: -2 * k] - height[2 * k :]) < _STEEPEST * way
    level &= off_ground & np.isfinite(height)
    return _Level(height[level], place[level])


def _levels(height: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights of treads one rise apart, of the rise with the most of them; empty below two.

    A tread has many points at its height, and few half a rise below.
    """
    count = int(_HIGHEST / _BIN)
    bins = np.floor(height / _BIN).astype(int)
    sums = np.bincount(bins[(bins >= 0) & (bins < count)], minlength=count)
    # Within half of _LEVEL of the middle of each bin.
    near = np.convolve(sums, np.ones(int(_LEVEL / _BIN) + 1), 'same')
    best, most = np.zeros(0), 0.0
    for rise in np.arange(_RISE[0], _RISE[1], _BIN / 4):
        at = np.arange(rise, _HIGHEST - _BIN, rise)
        on, off = near[(at / _BIN).astype(int)], near[((at - rise / 2) / _BIN).astype(int)]
        seen = (on >= _FEWEST) & (on >= _CLEAR * off)
        treads = len(seen) if seen.all() else int(np.argmin(seen))
        # Among rises with as many treads, the one that most points are of.
        score = treads + on[:treads].sum() / (1 + on.sum())
        if treads > 1 and score > most:
            best, most = at[:treads], score
    # As wide as the bins that were counted.
    wide = _LEVEL / 2 + _BIN
    return np.array([np.median(height[np.abs(height - level) < wide]) for level in best])


def _staircase(points: _Level, levels: NDArray[np.float64], terrain: Terrain) -> Stairs | None:
    """The staircase with treads at `levels`, negative below; None where the noses do not fit."""
    down = levels[0] < 0
    parts = [points.place[np.abs(points.height - level) < _LEVEL / 2] for level in levels]
    places = np.concatenate(parts)
    heights = np.repeat(levels, [len(part) for part in parts])
    # The plane through all treads rises along the stairs; each tread counts alike.
    weight = np.repeat([1 / len(part) for part in parts], [len(part) for part in parts])
    ahead = _gradient(places, heights, weight) * (-1 if down else 1)
    for _ in range(3):
        ahead = _turned(ahead, parts, down)
    across = np.array([-ahead[1], ahead[0]])
    sides = np.quantile(parts[0] @ across, (0.02, 0.98))
    noses, count = _noses([part @ ahead for part in parts], down)
    if count < 2 or sides[1] - sides[0] < _NARROWEST:
        return None
    # Boxes of several heights stand side by side, treads one behind the other.
    for part in parts[1:count]:
        left, right = np.quantile(part @ across, (0.02, 0.98))
        common = min(right, sides[1]) - max(left, sides[0])
        if common < min(right - left, sides[1] - sides[0]) / 2:
            return None
    run = float(np.median(np.diff(noses)))
    start = float(np.median(noses - run * np.arange(len(noses))))
    number = np.arange(1, count + 1)
    rise = float(np.abs(levels[:count]) @ number / (number @ number))
    if not _RISE[0] <= rise <= _RISE[1]:
        return None
    edge = start - run if down else start
    ends = edge * ahead + np.outer(sides, across)
    return Stairs(
        _on_ground(ends, terrain), float(np.diff(sides)[0]), count, rise, run,
        'down' if down else 'up',
    )  # fmt: skip


def _gradient(
    places: NDArray[np.float64], heights: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Unit direction in which a plane through the points rises."""
    design = np.column_stack([np.ones(len(places)), places]) * np.sqrt(weight)[:, None]
    slope = np.linalg.lstsq(design, heights * np.sqrt(weight), rcond=None)[0][1:]
    return slope / max(float(np.linalg.norm(slope)), 1e-9)


def _noses(along: list[NDArray[np.float64]], down: bool) -> tuple[NDArray[np.float64], int]:
    """Where the noses of treads are that follow each other at one run, and how many treads.

    Going down, a tread's nose is its far end; the landing, whose end is elsewhere, counts as the
    last tread.
    """
    first = _nose(along[0], down)
    second = along[1]
    if down:  # noise of what lies far beyond is at the same height
        second = second[(second > first) & (second < first + 1.2 * _RUN[1])]
    if len(second) < _FEWEST:
        return np.array([first]), 0
    noses = [first, _nose(second, down)]
    run = noses[1] - noses[0]
    if down and len(along) == 2:  # the second one may be the landing
        run = noses[0] - _nose(along[0], False)
        noses = noses[:1] if noses[1] - noses[0] > (1 + _UNEVEN) * run else noses
    if not _RUN[0] <= run <= _RUN[1]:
        return np.array(noses), 0
    count = 2
    for part in along[2:]:
        ahead = part - noses[-1]
        near = ahead < 1.5 * run if down else ahead > (1 - _UNEVEN) * run
        here = part[near & (ahead > 0)]
        if len(here) < _FEWEST:
            break
        nose = _nose(here, down)
        regular = abs(nose - noses[-1] - run) <= _UNEVEN * run
        if not regular and not down:
            break
        count += 1
        if not regular:
            break
        noses.append(nose)
    return np.array(noses), count


def _nose(along: NDArray[np.float64], down: bool) -> float:
    """Where a tread begins; going down, where it ends."""
    return float(np.quantile(along, 1 - _NOSE if down else _NOSE))


def _turned(
    ahead: NDArray[np.float64], parts: list[NDArray[np.float64]], down: bool
) -> NDArray[np.float64]:
    """`ahead`, turned to be at a right angle to the noses."""
    across = np.array([-ahead[1], ahead[0]])
    slopes, weights = [], []
    for part in parts[:-1] if down and len(parts) > 2 else parts:
        side, along = part @ across, part @ ahead
        bins = np.floor(side / 0.05).astype(int)
        edge = [
            (float(side[here].mean()), _nose(along[here], down))
            for k in np.unique(bins)
            if (here := bins == k).sum() >= 8
        ]
        if len(edge) < 5:
            continue
        x, y = np.array(edge).T
        # The lines between all pairs: their median slope heeds no corners (Theil and Sen).
        i, j = np.triu_indices(len(x), len(x) // 2)
        slopes.append(float(np.median((y[j] - y[i]) / (x[j] - x[i]))))
        weights.append(len(x))
    if not slopes:
        return ahead
    turned = ahead - np.average(slopes, weights=weights) * across
    return turned / float(np.linalg.norm(turned))


def _on_ground(ends: NDArray[np.float64], terrain: Terrain) -> NDArray[np.float64]:
    """Points (2, 3) of the ground under the robot at horizontal places."""
    axes = axes_of(terrain.field.up)
    theta = np.array(terrain.stand.theta)
    flat = ends @ axes[1:]
    depth = (1 - flat @ theta) / (axes[0] @ theta)
    result: NDArray[np.float64] = flat + depth[:, None] * axes[0]
    return result
