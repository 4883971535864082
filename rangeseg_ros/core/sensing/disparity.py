"""Images of disparity, or of inverse depth, that are taken for depth: found and undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import VGA
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.verdict import ODDS, SPREAD
from rangeseg_ros.core.significance import CLEARLY

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
    inverse, rays = _blocks(image)
    if not len(inverse):
        return False
    square = rays.transpose(0, 2, 1) @ rays
    # Rays of a very narrow view are all but one: rounding alone would make it singular.
    square += (
        np.finfo(np.float64).eps * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    )
    fit = np.linalg.inv(square) @ rays.transpose(0, 2, 1)
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
    flat = rough <= CLEARLY * np.median(rough)
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


def _blocks(image: RangeImage) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Inverse depths (N, S, 1) and rays (N, S, 3) of samples of blocks measured throughout."""
    step = max(round(_SIDE / _SAMPLES * (image.inverse.size / VGA) ** 0.5), 1)
    inverse, rays = image.inverse[::step, ::step], image.rays[::step, ::step]
    some = np.concatenate([inverse[..., None], rays], axis=2)
    rows, columns = (length // _SAMPLES for length in some.shape[:2])
    some = some[: rows * _SAMPLES, : columns * _SAMPLES].astype(np.float64)
    blocks = some.reshape(rows, _SAMPLES, columns, _SAMPLES, 4).transpose(0, 2, 1, 3, 4)
    blocks = blocks.reshape(rows * columns, _SAMPLES**2, 4)
    blocks = blocks[(blocks[:, :, 0] > 0).all(axis=1)]
    return blocks[..., :1], blocks[..., 1:]
