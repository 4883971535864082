"""Lens distortion: the models of OpenCV under their names in ROS, and their inverse.

A point z = x + i y in the plane at depth 1 appears at w, in units of the focal length. With
s = |z|^2 and the coefficients in the order of CameraInfo:

* plumb_bob, rational_polynomial (Brown; Claus and Fitzgibbon), coefficients
  k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]], with p = p2 + i p1:
  w = z (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3) + conj(p) z^2 + 2 p s
  + (s1 + i s3) s + (s2 + i s4) s^2
* equidistant (Kannala and Brandt), coefficients k1 k2 k3 k4, with z arctan|z| / |z| in place of z:
  w = z (1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4)

The inverse follows the branch that begins at the centre. Where a polynomial turns back, or rays
lie 90 degrees or more off the axis, a pixel has no ray.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Floats

# Numbers of coefficients that OpenCV takes; the last two of 14 are the tilt of the sensor.
_COUNTS = {'plumb_bob': (4, 5), 'rational_polynomial': (4, 5, 8, 12, 14), 'equidistant': (4,)}
MODELS = tuple(_COUNTS)

# The way from the centre to a pixel is followed in so many steps, each solved by Newton's method;
# enough for a field of view of 150 degrees to the rounding of float64.
_STEPS, _ITERATIONS = 12, 4
# Units of the focal length; a thousandth of a pixel of any camera.
_TOLERANCE = 1e-7

Complex = NDArray[Any]


def checked_lens(model: str, coefficients: Sequence[float]) -> tuple[str, tuple[float, ...]]:
    """A model, empty or 'none' for no distortion, and its coefficients in one form.

    That is ('', ()) where nothing is distorted. Raises ValueError for what is no lens.
    """
    d = tuple(float(value) for value in coefficients)
    if not np.isfinite(d).all():
        raise ValueError('lens distortion D must be finite')
    if model.lower() in ('', 'none') and not any(d):
        return '', ()
    if model not in _COUNTS:
        raise ValueError(f'unknown distortion model {model!r}; known: {", ".join(MODELS)}')
    counts = _COUNTS[model]
    if len(d) > counts[-1] and not any(d[counts[-1] :]):
        d = d[: counts[-1]]
    if d and len(d) not in counts:
        wanted = ' or '.join(map(str, counts))
        raise ValueError(f'distortion model {model} has {wanted} coefficients, not {len(d)}')
    if model == 'equidistant':
        return model, d or (0.0,) * 4
    if any(d[12:]):
        raise ValueError('lens distortion with a tilted sensor (coefficients 13, 14) is not known')
    return (model, d[:12]) if any(d) else ('', ())


def undistort(x: Floats, y: Floats, model: str, d: Sequence[float]) -> tuple[Floats, Floats]:
    """Points (...) of the plane that appear at (x, y), NaN where no ray comes from.

    The lens is as `checked_lens` returns it.
    """
    lens, radial = _lens(model, d), model == 'equidistant'
    point = x + 1j * y
    seen = np.abs(point) if radial else point
    found, unique = np.zeros_like(seen), np.ones(seen.shape, bool)
    with np.errstate(all='ignore'):
        # Once more at the end, to see that it is there.
        for step in [*np.repeat(np.arange(1, _STEPS + 1), _ITERATIONS), _STEPS]:
            place, along, across = lens(found)
            determinant = _square(along) - _square(across)
            # Both eigenvalues are positive: a branch that turned twice is another one.
            unique &= (determinant > 0) & (along.real > 0)
            missed = step / _STEPS * seen - place
            found = found + (along.conj() * missed - across * missed.conj()) / determinant
        unique &= _square(missed) < _TOLERANCE**2
        if radial:
            unique &= found < np.pi / 2
            found = point * np.where(seen > 0, np.tan(found) / seen, 1.0)
    return np.where(unique, found.real, np.nan), np.where(unique, found.imag, np.nan)


def _lens(model: str, d: Sequence[float]) -> Callable[[Complex], tuple[Complex, ...]]:
    """Function that tells where points z appear, and the derivatives by z and its conjugate."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = np.pad(d, (0, 12 - len(d)))
    above, below = Polynomial([1, k1, k2, k3]), Polynomial([1, k4, k5, k6])
    p, prism = p2 + 1j * p1, Polynomial([0, s1 + 1j * s3, s2 + 1j * s4])
    if model == 'equidistant':  # real for real z
        above, below, p, prism = Polynomial([1, *d]), Polynomial([1]), 0.0, Polynomial([0])

    def lens(z: Complex) -> tuple[Complex, ...]:
        s = _square(z)
        g = above(s) / below(s)
        slope = (above.deriv()(s) - g * below.deriv()(s)) / below(s)
        bent = 2 * p + prism.deriv()(s)
        along = g + slope * s + 2 * np.conj(p) * z + bent * z.conj()
        return z * (g + np.conj(p) * z) + 2 * p * s + prism(s), along, z * (slope * z + bent)

    return lens


def _square(z: Complex) -> Floats:
    return z.real**2 + z.imag**2
