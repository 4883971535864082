"""Alpha-expansion and alpha-beta-swap of every label over all of the image (thesis 4.8)."""

from __future__ import annotations

from functools import partial
from itertools import combinations
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.graphcut import expansion
from rangeseg_ros.core.graphcut.cut import ROUNDING, minimum_cut
from rangeseg_ros.core.graphcut.energy import link_costs
from rangeseg_ros.core.sensing.grid import Grid


class Cost(Protocol):
    """Data cost (n,) of a label at pixels (n,) given by their index in raster order."""

    def __call__(self, label: int, pixels: NDArray[np.integer], /) -> NDArray[np.floating]: ...


class Labelling:
    """A labelling of the 4-connected grid while its energy (eq. 5.3) is minimised.

    Parameters
    ----------
    labels : (H, W) int
        Labelling to start from.
    cost : Cost
    grid : Grid
    smoothness : float
        Lambda.

    Attributes
    ----------
    labels : (H * W,) int32
        In raster order.
    data : (H * W,) float32
        Data cost of each pixel's label.
    """

    def __init__(
        self, labels: NDArray[np.integer], cost: Cost, grid: Grid, smoothness: float
    ) -> None:
        self._shape = labels.shape
        self.labels = labels.astype(np.int32).ravel()
        self._cost = cost
        self.data = np.empty(labels.size, np.float32)
        self._state = expansion.GridLabelling.of(
            self.labels, self.data, link_costs(grid, smoothness), labels.shape[1]
        )
        for label in np.unique(self.labels):
            pixels = np.flatnonzero(self.labels == label)
            self.data[pixels] = cost(int(label), pixels)

    @property
    def image(self) -> NDArray[np.int32]:
        """The labelling, (H, W)."""
        return self.labels.reshape(self._shape)

    def minimise(self, count: int, moves: str = 'expansion', cycles: int = 0) -> None:
        """Try the moves of all labels (listing 4.1) until none helps.

        Parameters
        ----------
        count : int
            Number of labels.
        moves : {'expansion', 'swap'}
        cycles : int
            At most so many rounds of all moves; 0 for as many as help.
        """
        if moves == 'expansion':
            tries = [partial(self.expand, alpha) for alpha in range(count)]
        else:
            tries = [partial(self.swap, *pair) for pair in combinations(range(count), 2)]
        idle = done = 0
        while idle < len(tries) and (cycles == 0 or done < cycles * len(tries)):
            idle = 0 if tries[done % len(tries)]() else idle + 1
            done += 1

    def expand(self, alpha: int) -> bool:
        """Give label `alpha` to the best set of pixels; True if that lowers the energy."""
        pixels = np.flatnonzero(self.labels != alpha).astype(np.int32)
        cost = np.asarray(self._cost(alpha, pixels), np.float32)
        self._state.position[pixels] = np.arange(len(pixels))
        return bool(expansion.expand(alpha, pixels, cost, self._state, ROUNDING))

    def swap(self, alpha: int, beta: int) -> bool:
        """Share out the pixels of labels `alpha` and `beta` anew; True if the energy falls."""
        pixels = np.flatnonzero((self.labels == alpha) | (self.labels == beta))
        if not pixels.size:
            return False
        of_alpha, of_beta = self._cost(alpha, pixels), self._cost(beta, pixels)
        excess = of_alpha.astype(np.float64) - of_beta
        # Edges to other labels cost the same either way.
        place = np.full(len(self.labels), -1, np.int32)
        place[pixels] = np.arange(len(pixels))
        neighbour = np.full((len(pixels), 4), -1, np.int32)
        link = np.zeros((len(pixels), 4))
        for k, (links, offset) in enumerate(
            zip(self._state.links, (1, self._shape[1]), strict=True)
        ):
            one = np.flatnonzero(links[pixels] > 0)
            other = place[pixels[one] + offset]
            one, other = one[other >= 0], other[other >= 0]
            neighbour[one, k], neighbour[other, k + 2] = other, one
            link[one, k] = link[other, k + 2] = links[pixels[one]]
        chosen = minimum_cut(excess, neighbour, link)

        def value(chosen: NDArray[np.bool_]) -> float:
            # Each edge is seen from both ends.
            unlike = (neighbour >= 0) & (chosen[neighbour] != chosen[:, None])
            return excess[chosen].sum() + link[unlike].sum() / 2

        if value(chosen) >= value(self.labels[pixels] == alpha) - ROUNDING:
            return False
        self.labels[pixels] = np.where(chosen, alpha, beta)
        self.data[pixels] = np.where(chosen, of_alpha, of_beta)
        return True
