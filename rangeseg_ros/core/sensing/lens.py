"""Lens distortion: the models of OpenCV under their names in ROS, and their inverse.

A point at (x, y) in the plane z = 1 appears at the distorted point (x', y'), in units of the focal
length. With r^2 = x^2 + y^2 and theta = arctan r:

* plumb_bob, rational_polynomial (Brown; Claus and Fitzgibbon), coefficients
  k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]:
  x' = x g + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4,
  y' = y g + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4,
  g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
* equidistant (Kannala and Brandt), coefficients k1 k2 k3 k4:
  (x', y') = (x, y) theta / r (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

The inverse follows the branch that begins at the centre. Where a polynomial turns back, or rays
lie 90 degrees or more off the axis, a pixel has no ray.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

# Numbers of coefficients that OpenCV takes; the last two of 14 are the tilt of the sensor.
_COUNTS = {
    'plumb_bob': (4, 5),
    'rational_polynomial': (4, 5, 8, 12, 14),
    'equidistant': (4,),
}
MODELS = tuple(_COUNTS)

# The way from the centre to a pixel is followed in so many steps, each solved by Newton's method;
# enough for a field of view of 150 degrees to the rounding of float64.
_STEPS = 12
_ITERATIONS = 4
# Units of the focal length; a thousandth of a pixel of any camera.
_TOLERANCE = 1e-7


class LensError(ValueError):
    """Lens distortion of an unknown model, or with coefficients that the model does not have."""


def checked_lens(model: str, coefficients: Sequence[float]) -> tuple[str, tuple[float, ...]]:
    """Bring a model and its coefficients into one form: ('', ()) where nothing is distorted.

    Parameters
    ----------
    model : str
        One of `MODELS`; empty or 'none' for a lens that does not distort.
    coefficients : sequence of float
        Of the model, as CameraInfo.d; none means zeros.

    Raises
    ------
    LensError
        Another model, a wrong number of coefficients, coefficients that are not finite.
    """
    d = tuple(float(value) for value in coefficients)
    if not np.isfinite(d).all():
        raise LensError('lens distortion D must be finite')
    if model.lower() in ('', 'none') and not any(d):
        return '', ()
    if model not in _COUNTS:
        raise LensError(f'unknown distortion model {model!r}; known: {", ".join(MODELS)}')
    counts = _COUNTS[model]
    if len(d) > counts[-1] and not any(d[counts[-1] :]):
        d = d[: counts[-1]]
    if d and len(d) not in counts:
        wanted = ' or '.join(map(str, counts))
        raise LensError(f'distortion model {model} has {wanted} coefficients, not {len(d)}')
    if model == 'equidistant':
        return model, d or (0.0,) * 4
    if any(d[12:]):
        raise LensError('lens distortion with a tilted sensor (coefficients 13, 14) is not known')
    return (model, d[:12]) if any(d) else ('', ())


def undistort(
    x: NDArray[np.float64], y: NDArray[np.float64], model: str, d: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points in the plane z = 1 that appear at the distorted points (x, y).

    Parameters
    ----------
    x, y : (...) float64
        Distorted points, units of the focal length.
    model, d
        As `checked_lens` returns them.

    Returns
    -------
    x, y : (...) float64
        NaN where no ray comes from.
    """
    inverse = _equidistant_inverse if model == 'equidistant' else _polynomial_inverse
    with np.errstate(all='ignore'):
        return inverse(x, y, np.pad(np.asarray(d, float), (0, 12 - len(d))))


def _polynomial_inverse(
    x: NDArray[np.float64], y: NDArray[np.float64], d: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    u, v = np.zeros_like(x), np.zeros_like(y)
    unique = np.ones(x.shape, bool)
    for step in range(1, _STEPS + 1):
        for _ in range(_ITERATIONS):
            du, dv, (uu, uv, vu, vv) = _polynomial(u, v, d)
            determinant = uu * vv - uv * vu
            # Both eigenvalues are positive: a branch that turned twice is another one.
            unique &= (determinant > 0) & (uu + vv > 0)
            du, dv = step / _STEPS * x - du, step / _STEPS * y - dv
            u = u + (vv * du - uv * dv) / determinant
            v = v + (uu * dv - vu * du) / determinant
    du, dv, (uu, uv, vu, vv) = _polynomial(u, v, d)
    unique &= (np.hypot(du - x, dv - y) < _TOLERANCE) & (uu * vv > uv * vu) & (uu + vv > 0)
    return np.where(unique, u, np.nan), np.where(unique, v, np.nan)


def _polynomial(
    x: NDArray[np.float64], y: NDArray[np.float64], d: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[NDArray[np.float64], ...]]:
    """Distorted points, and their derivatives: of x' by x and y, of y' by x and y."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = d
    r = x * x + y * y
    above = 1 + r * (k1 + r * (k2 + r * k3))
    below = 1 + r * (k4 + r * (k5 + r * k6))
    g = above / below
    # By r^2.
    slope = k1 + r * (2 * k2 + r * 3 * k3) - g * (k4 + r * (2 * k5 + r * 3 * k6))
    slope /= below
    along, across = 2 * (s1 + 2 * s2 * r), 2 * (s3 + 2 * s4 * r)
    mixed = 2 * (x * y * slope + p1 * x + p2 * y)
    derivatives = (
        g + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x + x * along,
        mixed + y * along,
        mixed + x * across,
        g + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x + y * across,
    )
    return (
        x * g + 2 * p1 * x * y + p2 * (r + 2 * x * x) + r * (s1 + s2 * r),
        y * g + p1 * (r + 2 * y * y) + 2 * p2 * x * y + r * (s3 + s4 * r),
        derivatives,
    )


def _equidistant_inverse(
    x: NDArray[np.float64], y: NDArray[np.float64], d: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    radius = np.hypot(x, y)
    powers = np.arange(5)
    k = np.array([1.0, *d[:4]])
    value, slope = k[::-1], ((2 * powers + 1) * k)[::-1]
    theta = np.zeros_like(radius)
    unique = np.ones(x.shape, bool)
    for step in range(1, _STEPS + 1):
        for _ in range(_ITERATIONS):
            square = theta * theta
            rising = np.polyval(slope, square)
            unique &= rising > 0
            theta = theta + (step / _STEPS * radius - theta * np.polyval(value, square)) / rising
    missed = np.abs(theta * np.polyval(value, theta * theta) - radius)
    unique &= (missed < _TOLERANCE) & (theta < np.pi / 2) & (np.polyval(slope, theta**2) > 0)
    scale = np.where(radius > 0, np.tan(theta) / np.where(radius > 0, radius, 1), 1.0)
    scale = np.where(unique, scale, np.nan)
    return x * scale, y * scale
