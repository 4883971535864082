"""Images whose values are no distances but disparities, or a picture of depth: found and undone.

Distances z are proportional to 1 - q v of the values v, the largest of which is 1: q > 0 where
what is near is bright in a picture, q < 0 where it is dark and black is at some distance. A plane
is linear in 1 / (1 - q v) then, and in v where q = 0: that is a disparity.
"""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import VGA
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.verdict import ODDS, SPREAD
from rangeseg_ros.core.significance import CLEARLY, chi2_quantile, quantile

# Pixels of VGA along the side of a block, wide enough to show the bend, and those that tell it.
_SIDE, _SAMPLES = 48, 8
# Values of q, by quarters of octaves of 1 / (1 - q): farthest over nearest, or its inverse.
_Q = 1 - 2.0 ** np.arange(3, -4.1, -0.25)
# A disparity has no q to fit: what that explains must be more than chance.
_CHANCE = chi2_quantile(1) / 2
# Metres, about what indoor cameras see; for 2 to 4 of them as many planes of pictures are found.
_USUAL = 2.0


def encoding(image: RangeImage) -> float | None:
    """The q of an image, 0 for disparities; None where its values are distances.

    Of a plane theta . ray = 1/z, disparities taken for depths give 1 / (phi . ray), and other
    values a share 1 / (1 - q v) of that bend, distances none. Each block tells its share; the
    likelihoods are compared, with the tails of Cauchy's distribution, as most blocks are not flat.
    """
    if image.camera is None:
        return None
    inverse = _blocks(image.inverse[..., None])
    known = (inverse > 0).all(axis=(1, 2))
    if not known.any():
        return None
    least = inverse[inverse > 0].min()
    if image.camera not in _fits:
        # Rays of a very narrow view are all but one, but for the rounding of their squares.
        rays, precise = _blocks(image.rays), np.finfo(np.float64).eps ** 0.5
        _fits[image.camera] = rays, np.linalg.pinv(rays, rcond=precise)
    inverse, rays, fit = (each[known] for each in (inverse, *_fits[image.camera]))
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
    values = least * (1 / inverse[flat]).mean(axis=(1, 2))
    # Real planes differ by more than their noise tells.
    share, variance = share[flat], (noise / square)[flat] + SPREAD**2
    off = np.log1p((share - 1 / (1 - _Q[:, None] * values)) ** 2 / variance)
    # Of a curved surface, neighbours tell the same: two blocks count as one.
    odds = (np.log1p(share**2 / variance) - off).sum(axis=1) / 2
    # Only a picture, of 8 bits, has another q.
    if odds.max() > ODDS and len(np.unique(image.inverse[image.valid])) > 2**8:
        odds[_Q != 0] = 0
    return float(_Q[(odds + _CHANCE * (_Q == 0)).argmax()]) if odds.max() > ODDS else None


def decoded(image: RangeImage, q: float) -> RangeImage:
    """The image of distances that the values stand for, but for a factor."""
    values = np.divide(1, image.inverse, out=np.zeros(image.shape), where=image.valid)
    values /= values.max()
    inverse = 1 / (1 - q * values) * image.valid if q else values
    inverse /= _USUAL * np.median(inverse[image.valid])
    return replace(image, inverse=inverse.astype(np.float32))


# Rays (N, S, 3) of the blocks of a camera, as long as it lives, and their pseudo-inverses.
_fits: WeakKeyDictionary[Camera, tuple[NDArray[np.float64], ...]] = WeakKeyDictionary()


def _blocks(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """Samples (N, S, K) of values (H, W, K) in blocks."""
    step = max(round(_SIDE / _SAMPLES * (values[..., 0].size / VGA) ** 0.5), 1)
    some = values[::step, ::step].astype(np.float64)
    n, (rows, columns) = _SAMPLES, (length // _SAMPLES for length in some.shape[:2])
    blocks = some[: rows * n, : columns * n].reshape(rows, n, columns, n, some.shape[2])
    return blocks.transpose(0, 2, 1, 3, 4).reshape(rows * columns, n * n, some.shape[2])
