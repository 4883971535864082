"""From a labelling to regions: connected components, noise regions (thesis 5.10, 6.1.4)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config


def plane_regions(
    labels: NDArray[np.integer],
    valid: NDArray[np.bool_],
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
    config: Config,
) -> NDArray[np.uint16]:
    """Segmentation of a labelling: its connected components that are large enough for planes.

    Parameters
    ----------
    labels : (H, W) int
    valid : (H, W) bool
        Pixels without measurement become no plane.
    horizontal, vertical : (H, W-1), (H-1, W) float
        Neighbourhood weights.
    config : Config
        `noise_regions` and `min_pixels` are read.

    Returns
    -------
    (H, W) uint16
        0 = no plane, 1...M by falling size.
    """
    regions = np.where(valid, connected_components(labels, horizontal, vertical), 0)
    if config.noise_regions != 'leave':
        noise = is_noise(regions)
        if config.noise_regions == 'merge':
            regions = merge(regions, noise)
        regions = np.where(noise[regions], 0, regions)
    area = np.bincount(regions.ravel())
    area[0] = 0
    return relabel(regions, area >= config.min_pixels)


def connected_components(
    labels: NDArray[np.integer],
    horizontal: NDArray[np.floating],
    vertical: NDArray[np.floating],
) -> NDArray[np.int32]:
    """4-connected components of like labels that cross no disconnected edge.

    Parameters
    ----------
    labels : (H, W) int
    horizontal, vertical : (H, W-1), (H-1, W) float
        Neighbourhood weights, 0 where disconnected.

    Returns
    -------
    (H, W) int32
        1...N.
    """
    height, width = labels.shape
    # Pixels and the edges between them, drawn on a grid of twice the resolution.
    grid = np.zeros((2 * height - 1, 2 * width - 1), np.uint8)
    grid[::2, ::2] = 1
    grid[::2, 1::2] = (labels[:, 1:] == labels[:, :-1]) & (horizontal > 0)
    grid[1::2, ::2] = (labels[1:] == labels[:-1]) & (vertical > 0)
    components = cv2.connectedComponents(grid, connectivity=4, ltype=cv2.CV_32S)[1]
    return np.ascontiguousarray(components[::2, ::2])


def is_noise(regions: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Small or thin regions: fewer than two pixels per pixel of the perimeter (thesis eq. 6.3).

    Parameters
    ----------
    regions : (H, W) int32
        0...N.

    Returns
    -------
    (N + 1,) bool
        Whether region k is noise; never for region 0.
    """
    framed = cv2.copyMakeBorder(regions, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=-1)
    inner = framed[1:-1, 1:-1]
    perimeter = (
        (inner != framed[1:-1, 2:])
        | (inner != framed[1:-1, :-2])
        | (inner != framed[2:, 1:-1])
        | (inner != framed[:-2, 1:-1])
    )
    area = np.bincount(regions.ravel())
    noise = area < 2 * np.bincount(regions[perimeter], minlength=len(area))
    noise[0] = False
    return noise


def merge(regions: NDArray[np.int32], noise: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Erode noise regions: their pixels join the region most of their neighbours belong to.

    Repeated from the rims inwards until nothing changes (thesis 6.1.4). A noise region that
    touches no other region stays.

    Parameters
    ----------
    regions : (H, W) int32
        0...N; 0 is no region and takes no part.
    noise : (N + 1,) bool
    """
    height, width = regions.shape
    framed = np.pad(regions, 1).ravel()
    kept = ~noise
    kept[0] = False
    row = width + 2
    around = np.array([-row - 1, -row, -row + 1, -1, 1, row - 1, row, row + 1])
    pixels = np.flatnonzero(noise[framed])
    while pixels.size:
        neighbours = framed[pixels[:, None] + around]
        neighbours = np.where(kept[neighbours], neighbours, 0)
        # Votes for each neighbour's region; of equal counts the lowest region wins.
        votes = (neighbours[:, :, None] == neighbours[:, None, :]).sum(axis=2)
        votes = np.where(neighbours > 0, votes, 0)
        best = np.where(votes == votes.max(axis=1, keepdims=True), neighbours, len(noise))
        joined = votes.max(axis=1) > 0
        if not joined.any():
            break
        framed[pixels[joined]] = best.min(axis=1)[joined]
        pixels = pixels[~joined]
    return framed.reshape(height + 2, row)[1:-1, 1:-1].copy()


def relabel(regions: NDArray[np.integer], keep: NDArray[np.bool_]) -> NDArray[np.uint16]:
    """Number the regions to keep 1...M by falling size, the rest 0; at most 65535 are kept."""
    area = np.where(keep, np.bincount(regions.ravel(), minlength=len(keep)), 0)
    area[0] = 0
    order = np.argsort(-area, kind='stable')[: min(np.count_nonzero(area), 65535)]
    table = np.zeros(len(keep), np.uint16)
    table[order] = np.arange(1, len(order) + 1)
    return table[regions]
