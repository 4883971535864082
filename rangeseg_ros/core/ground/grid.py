"""What the ground around a robot is, in cells of a horizontal grid, remembered while it moves.

Cells add up evidence as the log-odds of danger (A. Hornung et al., "OctoMap", Autonomous Robots
2013): an obstacle or a drop counts at once, ground that is seen again and again takes it back.
Without the poses of the camera nothing is remembered: the grid is of one image.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats, Singles
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.ground.cells import DROP, GROUND, OBSTACLE, UNKNOWN, axes_of
from rangeseg_ros.core.ground.terrain import CellTerrain, Terrain
from rangeseg_ros.core.rotations import quaternions
from rangeseg_ros.core.significance import HIT, MISS, ODDS, OUTLIER


class GroundGrid(NamedTuple):
    """The ground around the robot, row by row along y, with x along the rows.

    Attributes
    ----------
    classes : (N, N) uint8
        As `Segmentation.terrain`.
    height : (N, N) float32
        Of the ground along z of the frame, metres; NaN where none was seen.
    variance : (N, N) float32
        Of the height, square metres.
    age : (N, N) float32
        Seconds since the cell was seen; inf where it is not known, never seen or too long ago.
    resolution : float
        Side of a cell, metres.
    origin : (3,) float64
        Corner of the first cell in the frame, metres; z is the ground below the camera.
    orientation : (4,) float64
        Quaternion of the grid's axes in the frame.
    frame : str
        Name of the fixed frame; empty for that of the image.
    """

    classes: NDArray[np.uint8]
    height: Singles
    variance: Singles
    age: Singles
    resolution: float
    origin: Floats
    orientation: Floats
    frame: str

    def __repr__(self) -> str:
        return (
            f'<GroundGrid {len(self.classes)}x{len(self.classes)}, {self.resolution:g} m a cell>'
        )


class GroundMemory:
    """What one camera has seen of the ground: the grid, and how high it is above the ground."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.forget()

    def forget(self) -> None:
        """Know nothing."""
        self._height_found, self._height_stamp = 0.0, 0
        self._forget_grid()

    def recall_height(self, stamp: int) -> float:
        """The height, metres, as it was found last; 0 for unknown."""
        age = stamp - self._height_stamp
        return self._height_found if age <= 1e9 * self.config.track_time else 0.0

    def keep_height(self, height: float, stamp: int) -> None:
        """Take a height that was found, metres, in the image of a time, nanoseconds."""
        self._height_found, self._height_stamp = height, stamp

    def _forget_grid(self) -> None:
        """Set empty layers (5, N, N): odds, height, variance, danger, time last seen (s)."""
        count = max(round(self.config.grid_size / self.config.grid_resolution), 1)
        self._layers = np.zeros((5, count, count))
        self._layers[4] = -np.inf
        self._corner = np.zeros(2, np.int64)

    def add(
        self,
        terrain: Terrain,
        up: Floats,
        stamp: int,
        place: Floats,
        pose: tuple[Floats, Floats] | None,
        frame: str = '',
    ) -> GroundGrid:
        """The grid with the terrain of an image taken at `stamp`, nanoseconds.

        `up` and `place` (3,) of the sensor are in the frame of the image; `pose` (rotation, shift)
        leads from there, with the sensor as origin, to the fixed frame named `frame`, with z up.
        """
        side, seconds = self.config.grid_resolution, stamp * 1e-9
        axes = axes_of(up)[[1, 2, 0]]  # ahead, left, up
        fixed = pose is not None and (pose[0] @ up)[2] > np.cos(np.pi / 4)
        rotation, shift = pose if fixed and pose else (axes, np.zeros(3))
        if not fixed:
            self._forget_grid()
        self._move_to(shift)
        if terrain.cells is not None:
            turn = rotation @ axes.T
            for kind, points, errors in _evidence(terrain.cells, self.config):
                self._count(kind, points @ turn.T + shift, errors, seconds)
        odds, height, variance, danger, seen = self._layers
        age = seconds - seen
        known = age <= self.config.grid_memory
        level = terrain.stand.height(up)
        origin = np.append(self._corner * side, shift[2] - (0 if np.isnan(level) else level))
        if not fixed:
            origin = axes.T @ origin + place
        classes = np.where(odds > 0, danger, np.where(odds < 0, GROUND, UNKNOWN))
        ground = known & (variance > 0)
        return GroundGrid(
            np.where(known, classes, UNKNOWN).astype(np.uint8),
            np.where(ground, height, np.nan).astype(np.float32),
            np.where(ground, variance, np.nan).astype(np.float32),
            np.where(known, age, np.inf).astype(np.float32),
            side,
            origin,
            quaternions(np.eye(3) if fixed else axes.T),
            frame if fixed else '',
        )

    def _cells_of(self, points: Floats) -> NDArray[np.int64]:
        """Numbers (..., 2) of the cells of points."""
        return np.floor(points[..., :2] / self.config.grid_resolution).astype(np.int64)

    def _move_to(self, centre: Floats) -> None:
        """Have the grid around a place; what leaves it is forgotten."""
        before, kept = self._corner, self._layers
        self._forget_grid()
        count = kept.shape[1]
        self._corner = self._cells_of(centre) - count // 2
        x, y = np.clip(self._corner - before, -count, count)
        # Of the old grid, the cells that are in the new one.
        old = slice(max(y, 0), count + min(y, 0)), slice(max(x, 0), count + min(x, 0))
        new = slice(max(-y, 0), count + min(-y, 0)), slice(max(-x, 0), count + min(-x, 0))
        self._layers[(slice(None), *new)] = kept[(slice(None), *old)]

    def _count(self, kind: int, points: Floats, errors: Floats, seconds: float) -> None:
        """Add points (N, 3) of the ground, or of a kind of danger; variances (N,) of heights."""
        odds, height, variance, danger, seen = (layer.reshape(-1) for layer in self._layers)
        count = self._layers.shape[1]
        index = self._cells_of(points) - self._corner
        inside = ((index >= 0) & (index < count)).all(axis=1)
        cells = index[inside, 1] * count + index[inside, 0]
        number = np.bincount(cells, minlength=count * count)
        hit = np.flatnonzero(number)
        seen[hit] = seconds
        if kind != GROUND:
            danger[hit] = kind
            odds[hit] = np.minimum(np.maximum(odds[hit], 0) + HIT, ODDS[1])
            return
        odds[hit] = np.maximum(odds[hit] + MISS, ODDS[0])
        mean, square = (
            np.bincount(cells, values[inside])[hit] / number[hit]
            for values in (points[:, 2], errors)
        )
        old, before = height[hit], variance[hit]
        # A Kalman filter; what differs by more than it errs begins anew.
        anew = (before == 0) | ((mean - old) ** 2 > OUTLIER**2 * (before + square))
        gain = np.where(anew, 1.0, before / np.maximum(before + square, 1e-12))
        height[hit] = old + gain * (mean - old)
        variance[hit] = np.where(anew, square, (1 - gain) * before)


def _evidence(cells: CellTerrain, config: Config) -> list[tuple[int, Floats, Floats]]:
    """Classes, points (N, 3) on axes ahead, left, up, metres, and the variances of their heights.

    Ground first, so that danger in the same cell counts more; far away its rows are far apart,
    and it is there between them as well. A drop is where the ground ends: its rays cross the
    ground continued.
    """
    place = cells.place[[1, 2, 0]].astype(np.float64)
    variance = cells.error.astype(np.float64) ** 2
    ground = cells.kind == GROUND
    both = ground[1:] & ground[:-1]
    near, far = place[:, :-1][:, both], place[:, 1:][:, both]
    way = np.hypot(*(far - near)[:2])
    number = np.maximum(np.ceil(way / config.grid_resolution), 1).astype(np.int64)
    pair = np.repeat(np.arange(len(number)), number)
    share = (np.arange(len(pair)) - np.repeat(number.cumsum() - number, number)) / number[pair]
    between = near[:, pair] + share * (far - near)[:, pair]
    points = np.concatenate([place[:, ground], between], axis=1)
    errors = np.concatenate([variance[ground], variance[1:][both][pair]])
    obstacle = (cells.kind == OBSTACLE) & (cells.height < config.grid_clearance)
    drop = (cells.kind == DROP) & np.isfinite(cells.crossing).all(axis=0)
    crossing = np.concatenate([cells.crossing, np.zeros((1, *drop.shape))])
    return [
        (GROUND, points.T, errors),
        (OBSTACLE, place[:, obstacle].T, variance[obstacle]),
        (DROP, crossing[:, drop].T, variance[drop]),
    ]
