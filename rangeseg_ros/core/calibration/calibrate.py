"""From the sightings of a recording to the distortion map, or to what the recording lacks."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.calibration.sightings import Sightings, cell_grid, cell_size
from rangeseg_ros.core.calibration.validation import (
    BLOCKS,
    Fold,
    learn,
    root_mean_square,
    without_plane,
)
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.distortion import DistortionMap

# Each block that is left out has two frames at least.
_FEWEST_FRAMES = 2 * BLOCKS
# Inverse depths that count as different views of a cell differ by this part.
_VIEW = 0.1
# Different views that most cells need, one more than the two coefficients of a cell: what one
# surface shows in one place may be its own shape.
_FEWEST_VIEWS = 3
ADVICE = (
    'record walls, floor and other flat things for half a minute while the camera moves slowly: '
    'nearer and farther, turned in all directions, so that flat surfaces cross every part of the '
    'image at several distances'
)


class CalibrationError(ValueError):
    """A recording from which the distortion cannot be learned."""


class Calibration(NamedTuple):
    """What was learned.

    Attributes
    ----------
    distortion : DistortionMap
    views : (rows, columns) int
        Different distances at which each cell was seen.
    profile : (W,) float64
        Bands of columns within the map, 1/m.
    gain : float
        Share of the field that held on frames left out.
    smoothness : tuple of float
        Of the offset and the slope.
    folds : list of Fold
        The blocks left out.
    """

    distortion: DistortionMap
    views: NDArray[np.intp]
    profile: NDArray[np.float64]
    gain: float
    smoothness: tuple[float, ...]
    folds: list[Fold]

    @property
    def before(self) -> float:
        """Root mean square residual of the cells of planes, 1/m."""
        return root_mean_square([(fold.weight, fold.before) for fold in self.folds])

    @property
    def after(self) -> float:
        """The same on frames left out, with the map of the others, 1/m."""
        return root_mean_square([(fold.weight, fold.after) for fold in self.folds])


def calibrate(
    seen: Sightings, shape: tuple[int, int], camera: Camera | None = None
) -> Calibration:
    """Learn the distortion of a sensor.

    Parameters
    ----------
    seen : Sightings
        Of all frames, in the order of time.
    shape : (int, int)
        Of the images.
    camera : Camera, optional
        Whose images they are.

    Raises
    ------
    CalibrationError
        The recording does not hold the distortion; the message says what to record.
    """
    views = _views(seen, shape)
    _check(seen, views)
    learned = learn(seen, shape)
    known = _in_pixels(views > 0, shape)
    offset = _smooth_in_pixels(learned.field[0], shape) + learned.profile
    slope = None
    if len(learned.field) > 1:
        slope = np.where(known, _smooth_in_pixels(learned.field[1], shape), 0)
        # One slope everywhere scales all planes, and leaves them planes.
        slope -= known * slope[known].mean()
        slope = slope.astype(np.float32)
    offset = without_plane(offset, known)
    deviation = np.where(known, _smooth_in_pixels(learned.deviation, shape), 0)
    distortion = DistortionMap(
        offset.astype(np.float32),
        deviation.astype(np.float32),
        slope,
        camera,
        0.0 if slope is None else learned.reference,
    )
    kept = learned.profile, learned.gain, learned.smoothness, learned.folds
    return Calibration(distortion, views, *kept)


def _views(seen: Sightings, shape: tuple[int, int]) -> NDArray[np.intp]:
    """Number of different distances at which each cell was seen."""
    rows, columns = cell_grid(shape)
    level = np.floor(np.log(np.maximum(seen.inverse, 1e-6)) / np.log1p(_VIEW)).astype(np.intp)
    pairs = np.unique(np.stack([seen.cell, level]), axis=1)
    return np.bincount(pairs[0], minlength=rows * columns).reshape(rows, columns)


def _check(seen: Sightings, views: NDArray[np.intp]) -> None:
    frames = len(np.unique(seen.frame))
    if frames < _FEWEST_FRAMES:
        raise CalibrationError(
            f'too few planes: {frames} of {len(seen.jumps)} frames show one that is large enough, '
            f'{_FEWEST_FRAMES} are needed; {ADVICE}'
        )
    covered = float((views > 0).mean())
    if covered < 0.5:
        raise CalibrationError(
            f'too few positions: planes cover {covered:.0%} of the image, '
            f'half of it is needed; {ADVICE}'
        )
    typical = int(np.median(views[views > 0]))
    if typical < _FEWEST_VIEWS:
        raise CalibrationError(
            f'too few ranges: most parts of the image see planes at no more than {typical} of the '
            f'{_FEWEST_VIEWS} distances that tell the sensor from the shape of things; {ADVICE}'
        )


def _in_pixels(cells: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
    size = cell_size(shape)
    return np.kron(cells, np.ones((size, size), np.bool_))[: shape[0], : shape[1]]


def _smooth_in_pixels(cells: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Values of cells (G,), linear between their middles."""
    size, (rows, columns) = cell_size(shape), cell_grid(shape)
    whole = cv2.resize(
        cells.reshape(rows, columns),
        (columns * size, rows * size),
        interpolation=cv2.INTER_LINEAR,
    )
    return np.asarray(whole, np.float64)[: shape[0], : shape[1]]
