"""Ground truth of a rendered scene: visible regions and their plane equations."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

NOT_PLANAR = 65535
"""Truth label of pixels on curved surfaces."""


@dataclass(frozen=True, eq=False)
class TruePlane:
    """Exact plane of a visible region: normal . p + distance = 0 in the sensor's frame.

    Attributes
    ----------
    label : int
        Value in the truth image, 1...
    face : int
        Number of the face in its scene: the identity that persists from frame to frame, shared
        by all regions into which occluders cut the face.
    normal : (3,) float64
        Unit normal towards the sensor.
    distance : float
        Distance of the origin from the plane, metres, positive.
    count : int
        Number of pixels.
    """

    label: int
    face: int
    normal: NDArray[np.float64]
    distance: float
    count: int


def visible_regions(
    face: NDArray[np.int32], planes: NDArray[np.float64]
) -> tuple[NDArray[np.uint16], list[TruePlane]]:
    """4-connected regions of the planar faces seen in an image.

    Parameters
    ----------
    face : (H, W) int32
        Number of the face seen by each pixel, -1 where nothing was measured.
    planes : (F, 4) float64
        Plane equations (normal, distance) of all faces in the frame of the sensor, NaN for
        curved faces.

    Returns
    -------
    labels : (H, W) uint16
        0 where nothing was measured, 65535 on curved faces, otherwise 1, 2, ... by face and
        then in reading order.
    regions : list of TruePlane
        In the order of their labels.
    """
    labels = np.zeros(face.shape, np.uint16)
    regions: list[TruePlane] = []
    for number in np.unique(face[face >= 0]):
        mask = face == number
        if np.isnan(planes[number]).any():
            labels[mask] = NOT_PLANAR
            continue
        count, components = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
        if len(regions) + count > NOT_PLANAR:
            raise ValueError(f'more than {NOT_PLANAR - 1} visible regions')
        labels[mask] = components[mask] + len(regions)
        sizes = np.bincount(components[mask], minlength=count)
        for size in sizes[1:]:
            regions.append(
                TruePlane(
                    label=len(regions) + 1,
                    face=int(number),
                    normal=planes[number, :3].copy(),
                    distance=float(planes[number, 3]),
                    count=int(size),
                )
            )
    return labels, regions
