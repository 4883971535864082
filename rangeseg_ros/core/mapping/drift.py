"""How fast poses drift, by how planes move through the map with the way that the camera goes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.mapping.plane_filter import PlaneFilters, Step
from rangeseg_ros.core.significance import OUTLIER, chi2_quantile
from rangeseg_ros.core.tracking.plane_errors import by_motion

# Metres of the way whose errors count as one at first, as neighbours in time have the same, and
# blocks that there are at most before they are united two by two.
_BLOCK, _BLOCKS = 0.2, 64


@dataclass
class DriftEstimate:
    """Shift of the poses per metre of the camera's way, by least squares.

    A pose that is off by delta s after s metres moves all planes by delta s. A plane that was
    observed after a mean of s0 metres differs now by delta (s - s0) along its normal, and by
    what the camera's direction errs by, which is estimated in each frame. The deviation is that
    of blocks of the way, whose errors are taken to be independent (White 1980), and what poses err
    by at both ends of the way.

    Attributes
    ----------
    noise : float
        Standard deviation of the places of the camera, metres.
    way : float
        Of the camera so far, metres.
    """

    noise: float
    way: float = 0.0
    _place: NDArray[np.float64] | None = None
    _block: float = _BLOCK
    _blocks: dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]] = field(
        default_factory=dict
    )

    def move(self, place: NDArray[np.float64]) -> None:
        """The camera is at `place` (3,) now; less than the noise of poses is no way."""
        if self._place is None:
            self._place = place
        step = float(np.linalg.norm(place - self._place))
        if step > OUTLIER * self.noise:
            self.way += step
            self._place = place

    def add(
        self,
        filters: PlaneFilters,
        step: Step,
        since: NDArray[np.float64],
        place: NDArray[np.float64],
        turn_noise: float,
    ) -> None:
        """Take in what the planes of a frame differ by.

        Parameters
        ----------
        filters : PlaneFilters
        step : Step
            K observations.
        since : (K,) float64
            Mean way at which their planes were observed, metres.
        place : (3,) float64
            Of the camera.
        turn_noise : float
            Standard deviation of its direction, radians.
        """
        normal = filters.normal[step.plane]
        design = by_motion(normal, filters.axes[step.plane], filters.point[step.plane] - place)
        design[:, 2, 3:] *= (since - self.way)[:, None]
        weighted = np.linalg.solve(step.spread, design).transpose(0, 2, 1)
        left = (weighted @ design).sum(axis=0)
        right = (weighted @ step.gap[..., None]).sum(axis=0)[:, 0]
        left[:3, :3] += np.eye(3) / max(turn_noise, 1e-6) ** 2
        # The turn is of this frame alone.
        solved = np.linalg.solve(left[:3, :3], np.column_stack([left[:3, 3:], right[:3]]))
        own = left[3:, 3:] - left[3:, :3] @ solved[:, :3]
        value = right[3:] - left[3:, :3] @ solved[:, 3]
        self._count(int(self.way / self._block), own, value)
        if len(self._blocks) > _BLOCKS:
            before, self._blocks = self._blocks, {}
            self._block *= 2
            for number, sums in before.items():
                self._count(number // 2, *sums)

    def _count(self, block: int, own: NDArray[np.float64], value: NDArray[np.float64]) -> None:
        before = self._blocks.get(block, (np.zeros((3, 3)), np.zeros(3)))
        self._blocks[block] = before[0] + own, before[1] + value

    def solution(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Drift (3,), metres per metre, and its covariance (3, 3); None where nothing tells."""
        if len(self._blocks) < 4 or not self.way:
            return None
        parts = list(self._blocks.values())
        left = np.sum([part[0] for part in parts], axis=0)
        # Directions that no plane tells are held by none drifting more than its whole way.
        inverse = np.linalg.inv(left + np.eye(3))
        drift = inverse @ np.sum([part[1] for part in parts], axis=0)
        rest = np.array([value - own @ drift for own, value in parts])
        ends = 2 * (self.noise / self.way) ** 2 * np.eye(3)
        return drift, inverse @ (rest.T @ rest) @ inverse + ends

    @property
    def significant(self) -> bool:
        """Whether the drift is larger than chance makes it (chi-squared, 0.999)."""
        found = self.solution()
        if found is None:
            return False
        drift, covariance = found
        return bool(drift @ np.linalg.pinv(covariance) @ drift > chi2_quantile(3))

    def __str__(self) -> str:
        found = self.solution()
        if found is None:
            return f'the poses drift by an unknown amount: {self.way:.1f} m are too short a way'
        drift, covariance = found
        size = float(np.linalg.norm(drift))
        deviation = np.sqrt(max(float(drift @ covariance @ drift), 0.0)) / max(size, 1e-12)
        return (
            f'the poses drift by {100 * size:.1f} +- {100 * deviation:.1f} % of the way '
            f'({self.way:.1f} m)'
        )
