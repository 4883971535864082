"""Alpha-expansion and alpha-beta-swap of every label over all of the image (thesis 4.8)."""

from __future__ import annotations

from functools import partial
from itertools import combinations
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.graphcut.cut import ROUNDING, minimum_cut
from rangeseg_ros.core.graphcut.energy import link_costs
from rangeseg_ros.core.graphcut.expansion import choice
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
        self._links = link_costs(grid, smoothness)
        self.data = np.empty(labels.size, np.float32)
        self._position = np.full(labels.size, -1, np.int32)
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
        self._position[pixels] = np.arange(len(pixels))
        links, width = self._links, self._shape[1]
        move = choice(alpha, pixels, cost, self.labels, self.data, links, width, self._position)
        return move.make(alpha, self.labels, self.data, ROUNDING)

    def swap(self, alpha: int, beta: int) -> bool:
        """Share out the pixels of labels `alpha` and `beta` anew; True if the energy falls."""
        pixels = np.flatnonzero((self.labels == alpha) | (self.labels == beta))
        if not pixels.size:
            return False
        of_alpha, of_beta = self._cost(alpha, pixels), self._cost(beta, pixels)
        excess = of_alpha.astype(np.float64) - of_beta
        # Edges to other labels cost the same either way; of the rest each once, right and down.
        inside = np.zeros(len(self.labels), np.bool_)
        inside[pixels] = True
        self._position[pixels] = np.arange(len(pixels))
        ends, capacity = [], []
        for links, offset in zip(self._links, (1, self._shape[1]), strict=True):
            one = pixels[links[pixels] > 0]
            one = one[inside[one + offset]]
            ends.append(self._position[[one, one + offset]])
            capacity.append(links[one].astype(np.float64))
        first, second = np.concatenate(ends, axis=1)
        link = np.concatenate(capacity)

        def value(chosen: NDArray[np.bool_]) -> float:
            return excess[chosen].sum() + link[chosen[first] != chosen[second]].sum()

        chosen = minimum_cut(excess, first, second, link)
        if value(chosen) >= value(self.labels[pixels] == alpha) - ROUNDING:
            return False
        self.labels[pixels] = np.where(chosen, alpha, beta)
        self.data[pixels] = np.where(chosen, of_alpha, of_beta)
        return True
