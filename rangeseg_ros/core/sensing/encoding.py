"""Images of disparity, or of inverse depth, that are taken for depth: found and undone."""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import VGA
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.verdict import ODDS, SPREAD
from rangeseg_ros.core.significance import CLEARLY, quantile

# Pixels of VGA along the side of a block, wide enough to show the bend, and those that tell it.
_SIDE, _SAMPLES = 48, 8


def shows_disparity(image: RangeImage) -> bool:
    """Whether surfaces are flat only if the values are disparities.

    Of a plane theta . ray = 1/z the disparity taken for a depth gives 1 / (phi . ray). Each block
    tells its share of that bend, 0 for depth and 1 for disparity; the likelihoods of the two are
    compared, with the tails of Cauchy's distribution, as most blocks are not flat.
    """
    if image.camera is None:
        return False
    inverse = _blocks(image.inverse[..., None])
    known = (inverse > 0).all(axis=(1, 2))
    if not known.any():
        return False
    fits = _fits.get(image.camera)
    if fits is None:
        # Rays of a very narrow view are all but one, but for the rounding of their squares.
        rays, precise = _blocks(image.rays), np.finfo(np.float64).eps ** 0.5
        fits = _fits[image.camera] = rays, np.linalg.pinv(rays, rcond=precise)
    inverse, rays, fit = inverse[known], fits[0][known], fits[1][known]
    # Behind the camera where no plane fits.
    level = np.maximum(rays @ (fit @ (1 / inverse)), 0.5 / inverse.max(axis=1, keepdims=True))
    both = np.concatenate([inverse, 1 / level], axis=2)
    # What planes leave of the values and of the bend.
    left, bend = np.moveaxis(both - rays @ (fit @ both), 2, 0)
    square = np.maximum((bend**2).sum(axis=1), 1e-30)
    share = (left * bend).sum(axis=1) / square
    noise = ((left - share[:, None] * bend) ** 2).sum(axis=1) / (_SAMPLES**2 - 4)
    noise += (np.finfo(np.float32).eps * inverse.max(axis=(1, 2))) ** 2
    # What is rougher than most, as where surfaces meet, is no part of a plane.
    rough = noise / inverse.max(axis=(1, 2)) ** 2
    flat = rough <= CLEARLY * quantile(rough, 0.5)
    # Real planes differ by more than their noise tells.
    variance = noise / square + SPREAD**2
    odds = np.log1p(share**2 / variance) - np.log1p((share - 1) ** 2 / variance)
    # Of a curved surface, neighbours tell the same: two blocks count as one.
    return bool(odds[flat].sum() / 2 > ODDS)


def from_disparity(image: RangeImage) -> RangeImage:
    """The image whose disparities the values are, at about the same distance."""
    known = image.inverse[image.valid]
    with np.errstate(divide='ignore'):
        values = np.where(image.valid, 1 / image.inverse, 0)
    return replace(image, inverse=(np.median(known) ** 2 * values).astype(np.float32))


# Rays of blocks (N, S, 3), and what makes of inverse depths along them the planes (N, 3, S) of
# least squares; of a camera, as long as it lives.
_fits: WeakKeyDictionary[Camera, tuple[NDArray[np.float64], ...]] = WeakKeyDictionary()


def _blocks(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """Samples (N, S, K) of values (H, W, K) in blocks."""
    step = max(round(_SIDE / _SAMPLES * (values[..., 0].size / VGA) ** 0.5), 1)
    some = values[::step, ::step].astype(np.float64)
    n, (rows, columns) = _SAMPLES, (length // _SAMPLES for length in some.shape[:2])
    blocks = some[: rows * n, : columns * n].reshape(rows, n, columns, n, some.shape[2])
    return blocks.transpose(0, 2, 1, 3, 4).reshape(rows * columns, n * n, some.shape[2])
