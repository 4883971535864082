"""Move spaces of thesis 4.8: alpha-expansion and alpha-beta-swap for a Potts energy.

The labelling problem lives on a graph of sites joined by weighted edges, so that a whole image,
its blocks or a band of pixels are minimised by the same code.

Both moves are binary problems, site p switching (x_p = 1) or staying (x_p = 0). In an expansion
an edge of weight w between sites of unlike labels, neither of them alpha, costs w unless both
ends switch, and

    w (1 - x_p x_q) = w/2 (1 - x_p) + w/2 (1 - x_q) + w/2 |x_p - x_q|,

so that it is cut as an n-link of w/2 and a cost w/2 of staying at each end: no auxiliary vertex
(thesis 4.7.2) is needed. An edge between like labels is an n-link of w. The same holds where one
end has the label alpha already and its site is fixed at x = 1: staying costs the other end
w/2 + w/2.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import maxflow
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.energy import angular_cost

# A move must lower the energy by more than the rounding of its sums.
ROUNDING = 1e-6


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
    unary = angular_cost(normals, directions).reshape(len(directions), -1)
    labelling = Labelling(
        Graph.of_grid(horizontal, vertical, smoothness), unary, unary.argmin(axis=0)
    )
    labelling.minimise(cycles, moves)
    return labelling.labels.reshape(normals.shape[:2])


@dataclass(frozen=True, eq=False)
class Graph:
    """Sites joined by edges.

    Attributes
    ----------
    size : int
        Number of sites.
    first, second : (M,) int32
        Ends of the edges.
    weight : (M,) float64
        Cost of unlike labels at the ends, lambda u of eq. 5.1 and 5.3.
    """

    size: int
    first: NDArray[np.int32]
    second: NDArray[np.int32]
    weight: NDArray[np.float64]

    @classmethod
    def of_grid(
        cls,
        horizontal: NDArray[np.floating],
        vertical: NDArray[np.floating],
        smoothness: float,
        sites: NDArray[np.bool_] | None = None,
    ) -> Graph:
        """Graph of the pixels of an image, or of those where `sites` is True, in raster order.

        Parameters
        ----------
        horizontal, vertical : (H, W-1), (H-1, W) float
            Neighbourhood weights; edges of weight 0 are left out.
        smoothness : float
            Lambda.
        sites : (H, W) bool, optional
            Pixels to keep.
        """
        shape = len(horizontal), vertical.shape[1]
        if sites is None:
            sites = np.ones(shape, bool)
        index = np.full(shape, -1, np.int32)
        size = np.count_nonzero(sites)
        index[sites] = np.arange(size, dtype=np.int32)
        right = (horizontal > 0) & sites[:, :-1] & sites[:, 1:]
        below = (vertical > 0) & sites[:-1] & sites[1:]
        return cls(
            size,
            np.concatenate([index[:, :-1][right], index[:-1][below]]),
            np.concatenate([index[:, 1:][right], index[1:][below]]),
            smoothness * np.concatenate([horizontal[right], vertical[below]]).astype(np.float64),
        )


class Labelling:
    """A labelling of a graph's sites under minimisation.

    Parameters
    ----------
    graph : Graph
    unary : (K, N) float
        Data cost of every label at every site.
    labels : (N,) int
        Labelling to start from.

    Attributes
    ----------
    labels : (N,) int
    """

    def __init__(
        self, graph: Graph, unary: NDArray[np.floating], labels: NDArray[np.integer]
    ) -> None:
        self.graph = graph
        self.unary = unary
        self._adopt(labels.astype(np.intp))

    def minimise(self, cycles: int, moves: str = 'expansion') -> None:
        """Try the moves of all labels (listing 4.1) until none helps, at most `cycles` times.

        Parameters
        ----------
        cycles : int
            At most so many rounds of all moves.
        moves : {'expansion', 'swap'}
        """
        count = len(self.unary)
        for _ in range(cycles):
            if moves == 'expansion':
                helped = [self.expand(alpha) for alpha in range(count)]
            else:
                helped = [self.swap(*pair) for pair in combinations(range(count), 2)]
            if not any(helped):
                return

    def expand(self, alpha: int) -> bool:
        """Give label `alpha` to the best set of sites; True if that lowers the energy."""
        graph, free = self.graph, self.labels != alpha
        excess = self.unary[alpha] - self._staying
        for inner, outer in ((graph.first, graph.second), (graph.second, graph.first)):
            pulled = np.flatnonzero(free[inner] & ~free[outer])
            excess -= np.bincount(inner[pulled], self._link[pulled], graph.size)
        if not (excess[free] < 0).any():
            return False
        switched = self._best(free, excess, self._link, np.zeros(graph.size, bool))
        if switched is None:
            return False
        self._adopt(np.where(switched, alpha, self.labels))
        return True

    def swap(self, alpha: int, beta: int) -> bool:
        """Share out the sites of labels `alpha` and `beta` anew; True if the energy falls."""
        before = self.labels == alpha
        free = before | (self.labels == beta)
        if not free.any():
            return False
        excess = np.subtract(self.unary[alpha], self.unary[beta], dtype=np.float64)
        switched = self._best(free, excess, self.graph.weight, before)
        if switched is None:
            return False
        self._adopt(np.where(switched, alpha, np.where(free, beta, self.labels)))
        return True

    def _best(
        self,
        free: NDArray[np.bool_],
        excess: NDArray[np.float64],
        link: NDArray[np.float64],
        before: NDArray[np.bool_],
    ) -> NDArray[np.bool_] | None:
        """Best set of free sites to give alpha to; None where it is no better than `before`.

        `excess` is what alpha costs a site more than the other choice, `link` what an edge costs
        when its ends choose differently.
        """
        first, second = self.graph.first, self.graph.second
        inner = np.flatnonzero(free[first] & free[second])
        sites = np.flatnonzero(free)
        index = np.empty(self.graph.size, np.intp)
        index[sites] = np.arange(len(sites))
        i, j = index[first[inner]], index[second[inner]]
        excess, link, before = excess[sites], link[inner], before[sites]

        def value(chosen: NDArray[np.bool_]) -> float:
            return excess[chosen].sum() + link[chosen[i] != chosen[j]].sum()

        chosen = _minimum_cut(excess, i, j, link)
        if value(chosen) >= value(before) - ROUNDING:
            return None
        switched = np.zeros(self.graph.size, bool)
        switched[sites] = chosen
        return switched

    def _adopt(self, labels: NDArray[np.intp]) -> None:
        """Take over a labelling and what staying with it costs."""
        graph = self.graph
        self.labels = labels
        unlike = labels[graph.first] != labels[graph.second]
        self._link = np.where(unlike, graph.weight / 2, graph.weight)
        half = self._link[unlike]
        self._staying = self.unary[labels, np.arange(graph.size)].astype(np.float64)
        for end in (graph.first, graph.second):
            self._staying += np.bincount(end[unlike], half, graph.size)


def _minimum_cut(
    excess: NDArray[np.float64],
    i: NDArray[np.intp],
    j: NDArray[np.intp],
    link: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Set of sites x that minimises sum excess[x] + sum link[x_i != x_j], (N,) bool."""
    graph = maxflow.GraphFloat(len(excess), len(i))
    nodes = graph.add_nodes(len(excess))
    graph.add_grid_tedges(nodes, np.maximum(excess, 0), np.maximum(-excess, 0))
    graph.add_edges(i, j, link, link)
    graph.maxflow()
    return graph.get_grid_segments(nodes)
