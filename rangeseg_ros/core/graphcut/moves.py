"""Alpha-expansion and alpha-beta-swap of every label over all of the image (thesis 4.8)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.graphcut import expansion
from rangeseg_ros.core.graphcut.cut import ROUNDING, minimum_cut
from rangeseg_ros.core.graphcut.energy import link_costs
from rangeseg_ros.core.sensing.grid import Grid

# Data cost (n,) of a label at pixels (n,) given by their index in raster order.
Cost = Callable[[int, NDArray[np.integer]], NDArray[np.floating]]


class Labelling:
    """A labelling (H, W) of the 4-connected grid while its energy (eq. 5.3) is minimised.

    `labels` and `data`, the cost of each pixel's label, are (H * W,), in raster order.
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
        """Try 'expansion' or 'swap' of all of `count` labels (listing 4.1) until none helps.

        At most so many `cycles` of all moves; 0 for as many as help.
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
        pixels = np.flatnonzero((self.labels == alpha) | (self.labels == beta)).astype(np.int32)
        of_alpha, of_beta = self._cost(alpha, pixels), self._cost(beta, pixels)
        # An expansion of alpha where all have beta.
        before = self.labels[pixels] == alpha
        self.labels[pixels], self.data[pixels] = beta, of_beta
        self._state.position[pixels] = np.arange(len(pixels))
        graph = expansion.switching(alpha, pixels, of_alpha, self._state)
        chosen = minimum_cut(*graph)
        helped = expansion.change(chosen, *graph) < expansion.change(before, *graph) - ROUNDING
        chosen = chosen if helped else before
        self.labels[pixels] = np.where(chosen, alpha, beta)
        self.data[pixels] = np.where(chosen, of_alpha, of_beta)
        return bool(helped)
