"""What every second column of every second row tells, for all pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.grid import GridEdges


def doubled_labels(labels: NDArray[np.uint16], valid: NDArray[np.bool_]) -> NDArray[np.uint16]:
    """Labels (H, W) of all measured pixels from those (ceil(H / 2), ceil(W / 2)) of some.

    A pixel takes the label of the one on its left and above, of even column and row.
    """
    height, width = valid.shape
    all_labels = labels.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return np.where(valid, all_labels, np.uint16(0))


def doubled_edges(edges: GridEdges, valid: NDArray[np.bool_]) -> GridEdges:
    """Jump edges between all measured pixels (H, W), where `doubled_labels` change."""
    height, width = valid.shape
    across = np.zeros((height, width - 1), np.bool_)
    across[:, 1::2] = edges[0].repeat(2, axis=0)[:height]
    down = np.zeros((height - 1, width), np.bool_)
    down[1::2] = edges[1].repeat(2, axis=1)[:, :width]
    return across & valid[:, 1:] & valid[:, :-1], down & valid[1:] & valid[:-1]
