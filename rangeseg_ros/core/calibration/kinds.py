"""How the error of a sensor may depend on the distance.

Disparity, of structured light and stereo, is the inverse depth but for a factor, and so its errors
are fixed in inverse depth. An error dr of the range is one of -y^2 dr / |r| of the inverse depth y
along the ray r = (x, y, 1). What depends on the distance otherwise has a slope over y.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.calibration.field import residuals
from rangeseg_ros.core.calibration.sightings import Sightings


class Kind(NamedTuple):
    """A field of K coefficients.

    Attributes
    ----------
    basis : (K, N) float64
        Factors of the coefficients at each cell that was seen.
    linear : (1 or 2, K) float64
        Turns the coefficients into the offset at a reference and, where there is one, the slope.
    """

    basis: NDArray[np.float64]
    linear: NDArray[np.float64]


def kinds(seen: Sightings, reference: float) -> tuple[Kind, Kind, Kind]:
    """Fields fixed in inverse depth, fixed in range, and with a slope over the inverse depth.

    Parameters
    ----------
    seen : Sightings
    reference : float
        Typical inverse depth, 1/m, at which all coefficients are of the size of the offset.
    """
    # Of the planes, not of the measurements: a slope that is the same everywhere is then free, as
    # it only scales the planes, and cannot explain the noise away.
    change = seen.inverse - residuals(seen, seen.inverse) - reference
    spread = max(1.4826 * float(np.median(np.abs(seen.inverse - reference))), 1e-6)
    one, square = np.ones(len(change)), (1 + change / reference) ** 2
    return (
        Kind(one[None], np.ones((1, 1))),
        # The tangent: a line through what was seen would follow the few nearest planes.
        Kind(square[None], np.array([[1.0], [2 / reference]])),
        Kind(np.stack([one, change / spread]), np.diag([1, 1 / spread])),
    )
