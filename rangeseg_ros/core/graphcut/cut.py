"""Moves as minimum cuts (thesis 4.7, 4.8; Boykov, Veksler and Zabih, TPAMI 2001).

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

import maxflow
import numpy as np
from numpy.typing import NDArray

ROUNDING = 1e-3
"""A move must lower the energy by more than the rounding of its sums."""


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
