"""Move spaces of thesis 4.8: alpha-expansion and alpha-beta-swap for a Potts energy on a grid.

Both moves are binary problems: a free pixel p switches to alpha (x_p = 1) or stays (x_p = 0),
and the best set of pixels to switch is a minimum cut. In an expansion, an edge of weight w
between pixels of unlike labels, neither of them alpha, costs w unless both ends switch, and

    w (1 - x_p x_q) = w/2 (1 - x_p) + w/2 (1 - x_q) + w/2 |x_p - x_q|,

so that it becomes an n-link of w/2 and a cost w/2 of staying at each end: no auxiliary vertex
(thesis 4.7.2) is needed. An edge between like labels is an n-link of w. With a neighbour q that
is not free, x_q is known, 1 if it has the label alpha and 0 otherwise, and the n-link becomes a
cost of staying or of switching.
"""

from __future__ import annotations

from functools import partial
from itertools import combinations
from typing import Protocol

import maxflow
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.graphcut.energy import AngularCost


class Cost(Protocol):
    """Data cost (n,) of a label at pixels (n,) given by their index in raster order, or at all."""

    def __call__(
        self, label: int, pixels: NDArray[np.intp] | None = None, /
    ) -> NDArray[np.floating]: ...


# A move must lower the energy by more than the rounding of its sums.
ROUNDING = 1e-3


class Labelling:
    """A labelling of the 4-connected grid while its energy (thesis eq. 5.3) is minimised.

    Parameters
    ----------
    labels : (H, W) int
        Labelling to start from.
    cost : Cost
    horizontal, vertical : (H, W-1), (H-1, W) float
        Weights u of eq. 5.1 between a pixel and its right and lower neighbour.
    smoothness : float
        Lambda.

    Attributes
    ----------
    labels : (H * W,) int32
        In raster order.
    data : (H * W,) float32
        Data cost of each pixel's label.
    cost : Cost
    """

    def __init__(
        self,
        labels: NDArray[np.integer],
        cost: Cost,
        horizontal: NDArray[np.floating],
        vertical: NDArray[np.floating],
        smoothness: float,
    ) -> None:
        self._shape = height, width = labels.shape
        self.labels = labels.astype(np.int32).ravel()
        self.cost = cost
        # Neighbours to the right, below, to the left, above; no weight beyond the image.
        self._offsets = np.array([[1], [width], [-1], [-width]])
        weight = np.zeros((4, height, width), np.float32)
        weight[0, :, :-1] = weight[2, :, 1:] = smoothness * horizontal
        weight[1, :-1] = weight[3, 1:] = smoothness * vertical
        self._weight = weight.reshape(4, -1)
        self.data = np.empty(labels.size, np.float32)
        self._position = np.full(labels.size, -1, np.int32)
        for label in np.unique(self.labels):
            pixels = np.flatnonzero(self.labels == label)
            self.data[pixels] = cost(int(label), pixels)

    @property
    def image(self) -> NDArray[np.int32]:
        """The labelling, (H, W)."""
        return self.labels.reshape(self._shape)

    def minimise(self, count: int, cycles: int, moves: str = 'expansion') -> None:
        """Try the moves of all labels (listing 4.1) until none helps.

        Parameters
        ----------
        count : int
            Number of labels.
        cycles : int
            At most so many rounds of all moves.
        moves : {'expansion', 'swap'}
        """
        if moves == 'expansion':
            tries = [partial(self.expand, alpha) for alpha in range(count)]
        else:
            tries = [partial(self.swap, *pair) for pair in combinations(range(count), 2)]
        idle = 0
        for _ in range(cycles):
            for move in tries:
                idle = 0 if move() else idle + 1
                if idle == len(tries):
                    return

    def expand(self, alpha: int, pixels: NDArray[np.intp] | None = None) -> bool:
        """Give label `alpha` to the best set of pixels; True if that lowers the energy.

        Parameters
        ----------
        alpha : int
        pixels : (n,) int, optional
            Pixels that may switch, all by default.
        """
        if pixels is None:
            pixels = np.flatnonzero(self.labels != alpha)
        else:
            pixels = pixels[self.labels[pixels] != alpha]
        neighbours, weight, free = self._surroundings(pixels)
        theirs = self.labels[neighbours]
        unlike = theirs != self.labels[pixels]
        half = unlike * weight / 2
        link = weight - half
        cost = self.cost(alpha, pixels)
        known = np.where(theirs == alpha, -link, link)
        excess = cost - self.data[pixels] - half.sum(axis=0) + np.where(free, 0, known).sum(axis=0)
        if not (excess < 0).any():
            return False
        chosen = self._best(pixels, excess, neighbours, free, link, np.zeros(len(pixels), bool))
        if chosen is None:
            return False
        self.labels[pixels[chosen]] = alpha
        self.data[pixels[chosen]] = cost[chosen]
        return True

    def swap(self, alpha: int, beta: int) -> bool:
        """Share out the pixels of labels `alpha` and `beta` anew; True if the energy falls."""
        pixels = np.flatnonzero((self.labels == alpha) | (self.labels == beta))
        if not pixels.size:
            return False
        neighbours, weight, free = self._surroundings(pixels)
        costs = self.cost(alpha, pixels), self.cost(beta, pixels)
        before = self.labels[pixels] == alpha
        # Edges to other labels cost the same either way.
        chosen = self._best(pixels, costs[0] - costs[1], neighbours, free, weight, before)
        if chosen is None:
            return False
        self.labels[pixels] = np.where(chosen, alpha, beta)
        self.data[pixels] = np.where(chosen, *costs)
        return True

    def _surroundings(
        self, pixels: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.bool_]]:
        """Neighbours (4, n) of some pixels, the weights, and whether they are of the pixels."""
        neighbours = pixels + self._offsets
        weight = self._weight[:, pixels]
        # Beyond the first and last row there is no pixel and the weight is 0.
        np.clip(neighbours, 0, len(self.labels) - 1, out=neighbours)
        self._position[pixels] = np.arange(len(pixels))
        free = self._position[neighbours] >= 0
        self._position[pixels] = -1
        return neighbours, weight, free

    def _best(
        self,
        pixels: NDArray[np.intp],
        excess: NDArray[np.floating],
        neighbours: NDArray[np.intp],
        free: NDArray[np.bool_],
        link: NDArray[np.float32],
        before: NDArray[np.bool_],
    ) -> NDArray[np.bool_] | None:
        """Best choice of pixels for alpha, None where it is no better than the choice `before`.

        `excess` is what alpha costs a pixel more than the other label, `link` what an edge costs
        whose ends choose differently.
        """
        self._position[pixels] = np.arange(len(pixels))
        # Each edge once: to the right and down.
        once = free[:2] & (link[:2] > 0)
        i = np.broadcast_to(np.arange(len(pixels)), once.shape)[once]
        j = self._position[neighbours[:2][once]]
        self._position[pixels] = -1
        capacity = link[:2][once].astype(np.float64)
        price = excess.astype(np.float64)

        def value(chosen: NDArray[np.bool_]) -> float:
            return price[chosen].sum() + capacity[chosen[i] != chosen[j]].sum()

        chosen = minimum_cut(price, i, j, capacity)
        return chosen if value(chosen) < value(before) - ROUNDING else None


def minimum_cut(
    excess: NDArray[np.float64],
    i: NDArray[np.integer],
    j: NDArray[np.integer],
    capacity: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Choice x (n,) bool that minimises sum excess x + sum capacity |x_i - x_j|.

    Parameters
    ----------
    excess : (n,) float64
        Cost of choosing a node, of either sign.
    i, j : (m,) int
        Ends of the edges.
    capacity : (m,) float64
        Cost of an edge whose ends are not chosen alike, not negative.
    """
    graph = maxflow.GraphFloat(len(excess), len(i))
    nodes = graph.add_nodes(len(excess))
    graph.add_grid_tedges(nodes, np.maximum(excess, 0), np.maximum(-excess, 0))
    graph.add_edges(i, j, capacity, capacity)
    graph.maxflow()
    return graph.get_grid_segments(nodes)


def minimise(
    normals: NDArray[np.float32],
    directions: NDArray[np.floating],
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
    smoothness: float,
    cycles: int,
    moves: str = 'expansion',
) -> NDArray[np.intp]:
    """Labelling of low energy by moves of every direction at full resolution.

    Parameters and result as in `coarse_to_fine.minimise`.
    """
    cost = AngularCost(normals, directions)
    nearest = cost.nearest().reshape(normals.shape[:2])
    labelling = Labelling(nearest, cost, horizontal, vertical, smoothness)
    labelling.minimise(len(directions), cycles, moves)
    return labelling.image.astype(np.intp)
