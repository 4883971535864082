"""Images whose values are no distances but disparities, or a picture of depth: found and undone.

Distances z are proportional to 1 - q v of the values v, the largest of which is 1: q > 0 where
what is near is bright in a picture, q < 0 where it is dark and black is at some distance. A plane
is linear in 1 / (1 - q v) then, and in v where q = 0: that is a disparity.
"""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from numba import njit

from rangeseg_ros.core.arrays import Floats, Singles
from rangeseg_ros.core.config import VGA
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.verdict import ODDS, SPREAD
from rangeseg_ros.core.significance import CLEARLY, chi2_quantile, quantile

# Pixels of VGA along the side of a block, wide enough to show the bend, and those that tell it.
_SIDE, _SAMPLES = 48, 8
# Values of q, by quarters of octaves of 1 / (1 - q): farthest over nearest, or its inverse.
_Q = 1 - 2.0 ** np.arange(3, -4.1, -0.25)
_ROUNDING = float(np.finfo(np.float32).eps)
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
    step = max(round(_SIDE / _SAMPLES * (image.inverse.size / VGA) ** 0.5), 1)
    if image.camera not in _fits:
        # Rays of a very narrow view are all but one, but for the rounding of their squares.
        rays, precise = _blocks(image.rays, step), np.finfo(np.float64).eps ** 0.5
        _fits[image.camera] = rays, np.linalg.pinv(rays, rcond=precise)
    least, found = _shares(image.inverse, step, *_fits[image.camera])
    share, variance, rough, values = found[found[:, 3] > 0].T
    if not len(share):
        return None
    # What is rougher than most, as where surfaces meet, is no part of a plane.
    flat = rough <= CLEARLY * quantile(rough, 0.5)
    # Real planes differ by more than their noise tells.
    share, variance = share[flat], variance[flat] + SPREAD**2
    off = np.log1p((share - 1 / (1 - _Q[:, None] * least * values[flat])) ** 2 / variance)
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
_fits: WeakKeyDictionary[Camera, tuple[Floats, ...]] = WeakKeyDictionary()


def _blocks(values: Singles, step: int) -> Floats:
    """Samples (N, S, K) of values (H, W, K) in blocks: every so many pixels."""
    some = values[::step, ::step].astype(np.float64)
    n, (rows, columns) = _SAMPLES, (length // _SAMPLES for length in some.shape[:2])
    blocks = some[: rows * n, : columns * n].reshape(rows, n, columns, n, some.shape[2])
    return blocks.transpose(0, 2, 1, 3, 4).reshape(rows * columns, n * n, some.shape[2])


@njit(cache=True, nogil=True)
def _shares(inverse: Singles, step: int, rays: Floats, fit: Floats) -> tuple[float, Floats]:
    """The least inverse range in blocks, and of each its share of the bend (N, 4).

    With its variance by noise, the variance of noise relative to the largest square, and the mean
    range; zeros of blocks where a sample was not measured.
    """
    columns = -(-inverse.shape[1] // step) // _SAMPLES
    y, bent, fits = np.empty(rays.shape[1]), np.empty(rays.shape[1]), np.empty((3, 3))
    found, least = np.zeros((len(rays), 4)), np.inf
    for n in range(len(rays)):
        top, begin, most, known = n // columns * _SAMPLES, n % columns * _SAMPLES, 0.0, True
        for k in range(len(y)):
            y[k] = inverse[(top + k // _SAMPLES) * step, (begin + k % _SAMPLES) * step]
            known, most = known and y[k] > 0, max(most, y[k])
            least = min(least, y[k] if y[k] > 0 else np.inf)
        if not known:
            continue
        fits[:], far = 0, 0.0
        for k in range(len(y)):
            far += 1 / y[k] / len(y)
            for c in range(3):
                fits[0, c] += fit[n, c, k] * y[k]
                fits[1, c] += fit[n, c, k] / y[k]
        for k in range(len(y)):
            # Behind the camera where no plane fits.
            bent[k] = 1 / max(_along(fits[1], rays[n, k]), 0.5 / most)
            for c in range(3):
                fits[2, c] += fit[n, c, k] * bent[k]
        # What planes leave of the values and of the bend.
        own = both = square = 0.0
        for k in range(len(y)):
            left, bend = y[k] - _along(fits[0], rays[n, k]), bent[k] - _along(fits[2], rays[n, k])
            own, both, square = own + left * left, both + left * bend, square + bend * bend
        square = max(square, 1e-30)
        noise = max(own - both * both / square, 0.0) / (len(y) - 4) + (_ROUNDING * most) ** 2
        found[n, 0], found[n, 1] = both / square, noise / square
        found[n, 2], found[n, 3] = noise / (most * most), far
    return least, found


@njit(cache=True, inline='always')
def _along(theta: Floats, ray: Floats) -> float:
    return theta[0] * ray[0] + theta[1] * ray[1] + theta[2] * ray[2]
