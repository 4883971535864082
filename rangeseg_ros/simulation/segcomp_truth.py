"""Ground truth of a simulated scan in the conventions of the segmentation comparison."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.segcomp.files import FIRST_REGION, RegionAngle, to_segcomp
from rangeseg_ros.simulation.scanners import Scan
from rangeseg_ros.simulation.truth import TruePlane

MIN_PIXELS = 100
"""Smaller regions are left unlabelled, as in truth that is drawn by hand."""
MIN_CONTACT = 10
"""Pairs of neighbouring pixels from which two regions count as adjacent."""


def ground_truth(scan: Scan) -> tuple[NDArray[np.uint8], list[TruePlane]]:
    """Image of a `.gt-seg` file and the planes of its regions.

    Returns
    -------
    image : (512, 512) uint8
        0 unlabelled, 2 shadow, regions from 10.
    planes : list of TruePlane
        With the labels of the image.

    Raises
    ------
    SegcompError
        More than 246 regions.
    """
    planes = [plane for plane in scan.planes if plane.count >= MIN_PIXELS]
    kept = np.isin(scan.labels, [plane.label for plane in planes])
    image = to_segcomp(np.where(kept, scan.labels, 0), shadow=scan.labels == 0)
    return image, [
        replace(plane, label=label) for label, plane in enumerate(planes, start=FIRST_REGION)
    ]


def region_angles(image: NDArray[np.uint8], planes: list[TruePlane]) -> list[RegionAngle]:
    """Angles of a `.gt-ang` file, between the planes of regions that touch, 0 to 90 degrees."""
    sides = [(image[:, :-1], image[:, 1:]), (image[:-1], image[1:])]
    touching = np.concatenate([np.stack([a[a != b], b[a != b]], axis=1) for a, b in sides])
    pairs, contacts = np.unique(np.sort(touching, axis=1), axis=0, return_counts=True)
    normals = {plane.label: plane.normal for plane in planes}
    angles = []
    for (a, b), contact in zip(pairs.tolist(), contacts, strict=True):
        if contact >= MIN_CONTACT and a >= FIRST_REGION:
            cosine = np.clip(np.abs(normals[a] @ normals[b]), 0, 1)
            angles.append(RegionAngle(a, b, float(np.degrees(np.arccos(cosine)))))
    return angles
