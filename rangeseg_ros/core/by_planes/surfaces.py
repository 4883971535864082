"""First planes: blocks grow to patches, patches join to surfaces.

Agglomerative clustering on the adjacency of blocks, as in Feng, Taguchi and Kamat (ICRA 2014),
with tests that count the sensor's variances. Real sensors bend planes smoothly, so how far two
parts may leave their common plane cannot be one number: the plane a patch of a wall suggests is
off by the distortion where the wall ends, yet the patch beside it agrees. Hence two steps. Blocks
merge to patches small enough for the distortion to be nearly constant; patches join where they
agree with their neighbours, averaged along the common border, and the surface as a whole stays
within the distortion.

Where noise is strong, chance alone leaves parts of a face apart, and looser tests would join faces
that meet. What decides then is the energy that the labelling minimises: surfaces unite as long as
one plane costs their pixels less than their common border does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.by_planes.blocks import Nodes
from rangeseg_ros.core.by_planes.contacts import (
    Contacts,
    absorb,
    find_contacts,
    least_contact,
)
from rangeseg_ros.core.by_planes.patches import find_roots, grow_patches, misfit
from rangeseg_ros.core.runtime.threads import map_halves
from rangeseg_ros.core.sensing.moments import COUNT, RATIO, SIZE, common_residual, fit
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.core.significance import OUTLIER, chi2_quantile

# Systematic variances granted between neighbouring patches, which is no chance; and within a
# surface, whose extremes are four standard deviations apart: the variance of a difference is twice
# that of one.
_BETWEEN_PATCHES, _WITHIN_SURFACE = chi2_quantile(1), 2 * OUTLIER**2
# Blocks of the smallest patch, two by two: fewer hardly determine the direction of a plane, and
# where a face is rough they are splinters of it.
_BLOCKS_OF_PATCH = 4


class Patches(NamedTuple):
    """Connected blocks on one plane, over which the distortion is nearly constant.

    Attributes
    ----------
    labels : (rows, columns) int32
        Patch of each block: 0 for none, otherwise 1...P.
    moments : (P + 1, 13) float64
        Of the patches; zeros for 0.
    """

    labels: NDArray[np.int32]
    moments: NDArray[np.float64]

    @classmethod
    def of(cls, nodes: Nodes, block: int, sensor: SensorModel) -> Patches:
        """Patches of blocks.

        Parameters
        ----------
        nodes : Nodes
            (rows, columns).
        block : int
            Rows and columns of a block.
        sensor : SensorModel
            Its `agreement` and `distortion_pixels` are read.
        """
        shape = nodes.residual.shape
        # No patch reaches over the middle, but neither does any reach across a large surface.
        # Not even in a small image is one smaller than four blocks.
        largest = max(sensor.distortion_pixels, 4.0 * block**2)
        smallest = float(_BLOCKS_OF_PATCH * block**2)
        halves = map_halves(_patches, shape[0], nodes, largest, smallest, sensor.agreement)
        labels, moments = _put_together(*halves[0], *halves[1])
        return cls(labels.reshape(shape), moments)


def join_surfaces(
    patches: Patches,
    nodes: Nodes,
    block: int,
    sensor: SensorModel,
    smoothness: float,
    least: int = 1,
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Group blocks into planar surfaces.

    Parameters
    ----------
    patches : Patches
        Of the blocks.
    nodes : Nodes
        (rows, columns).
    block : int
        Rows and columns of a block.
    sensor : SensorModel
        Its `agreement`, `patch` and `distortion_pixels` are read.
    smoothness : float
        Of the energy's prior, see `Problem.of`.
    least : int
        Pixels of the smallest surface.

    Returns
    -------
    labels : (rows, columns) int32
        0 where no surface is, otherwise 1...K.
    moments : (K + 1, 13) float64
        Of the surfaces; zeros for 0.
    """
    # What a block's side of border costs.
    side = smoothness * sensor.patch * block
    smooth, agreement = sensor.distortion_pixels, sensor.agreement
    return _surfaces(patches, nodes.right, nodes.below, smooth, agreement, side, float(least))


@njit(cache=True, nogil=True)
def _surfaces(
    patches: Patches,
    right: NDArray[np.bool_],
    below: NDArray[np.bool_],
    smooth: float,
    agreement: float,
    side: float,
    least: float,
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """What `join_surfaces` returns."""
    labels, moments = patches.labels.copy(), patches.moments
    contacts = find_contacts(labels, right, below, len(moments))
    part, moments = _renumber(_join(moments, contacts, smooth, agreement), moments, 1.0)
    _rename(labels, part)
    contacts = find_contacts(labels, right, below, len(moments))
    surface, moments = _renumber(_unite(moments, contacts, side, smooth), moments, least)
    _rename(labels, surface)
    return labels, moments


@njit(cache=True, nogil=True)
def _rename(labels: NDArray[np.int32], table: NDArray[np.int32]) -> None:
    """Labels by another name, in place."""
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            labels[i, j] = table[labels[i, j]]


@njit(cache=True, nogil=True)
def _patches(
    first: int, after: int, nodes: Nodes, largest: float, least: float, agreement: float
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Patches of at least so many pixels in some rows of blocks, 1...P, and their moments."""
    begin, end = first * nodes.residual.shape[1], after * nodes.residual.shape[1]
    roots = grow_patches(first, after, nodes, largest, agreement) - begin
    return _renumber(roots, nodes.moments.reshape(-1, SIZE)[begin:end], least)


@njit(cache=True, nogil=True)
def _put_together(
    upper: NDArray[np.int32],
    first: NDArray[np.float64],
    lower: NDArray[np.int32],
    second: NDArray[np.float64],
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Labels and moments of two halves as those of the whole."""
    labels = np.concatenate((upper, lower))
    for a in range(len(upper), len(labels)):
        labels[a] += (labels[a] > 0) * (len(first) - 1)
    return labels, np.concatenate((first, second[1:]))


@njit(cache=True, nogil=True)
def _renumber(
    root: NDArray[np.intp], moments: NDArray[np.float64], least: float
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Number the clusters of at least so many pixels 1...K, the rest 0; their moments."""
    count = np.zeros(len(root))
    for a in range(len(root)):
        count[root[a]] += moments[a, COUNT]
    number = np.zeros(len(root), np.int32)
    clusters = 0
    for a in range(len(root)):
        if count[a] >= least:
            clusters += 1
            number[a] = clusters
    labels = np.zeros(len(root), np.int32)
    total = np.zeros((clusters + 1, SIZE))
    for a in range(len(root)):
        labels[a] = number[root[a]]
        if labels[a] > 0:
            for entry in range(SIZE):
                total[labels[a], entry] += moments[a, entry]
    return labels, total


@njit(cache=True, nogil=True)
def _join(
    moments: NDArray[np.float64], contacts: Contacts, smooth: float, agreement: float
) -> NDArray[np.intp]:
    """Join patches 1...P to surfaces, those that agree best first; returns the roots.

    The strain between two surfaces is the mean misfit of the patches on either side of their
    border. `smooth` is `SensorModel.distortion_pixels`, `agreement` as in `misfit`. The contacts
    are used up.
    """
    moments, parent = moments.copy(), np.arange(len(moments))
    residual = _residuals(moments)
    length, target = contacts.length, contacts.target
    # Of contacts: the strain along the border, and its mean where surfaces may join. Of each
    # surface: the contact with a later one of least mean strain, and this.
    strain, mean = np.zeros(len(length)), np.zeros(len(length))
    nearest, least = np.full(len(moments), -1), np.full(len(moments), np.inf)
    for e in range(len(length)):
        a, b = min(target[2 * e], target[2 * e + 1]), max(target[2 * e], target[2 * e + 1])
        extra = common_residual(moments, a, b) - residual[a] - residual[b]
        apart = misfit(extra, moments, a, b, _BETWEEN_PATCHES, agreement)
        strain[e] = apart * length[e]
        mean[e] = strain[e] / length[e]
    for a in range(len(moments)):
        nearest[a], least[a] = least_contact(contacts, mean, a, np.inf)
    while True:
        a, strained = _smallest(least)
        if not strained < 1:
            break
        b = target[nearest[a]]
        chi2 = common_residual(moments, a, b)
        extra = chi2 - residual[a] - residual[b]
        pixels = moments[a, COUNT] + moments[b, COUNT]
        within = _WITHIN_SURFACE * pixels / (pixels + smooth)
        if misfit(extra, moments, a, b, within, agreement) >= 1:
            mean[nearest[a] // 2] = np.inf
            nearest[a], least[a] = least_contact(contacts, mean, a, np.inf)
            continue
        parent[b], residual[a], least[b] = a, chi2, np.inf
        moments[a] += moments[b]
        absorb(contacts, strain, a, b)
        h = contacts.head[a]
        while h >= 0:
            mean[h // 2] = strain[h // 2] / length[h // 2]
            c = target[h]
            nearest[c], least[c] = least_contact(contacts, mean, c, np.inf)
            h = contacts.link[h]
        nearest[a], least[a] = least_contact(contacts, mean, a, np.inf)
    return find_roots(parent)


@njit(cache=True, nogil=True)
def _unite(
    moments: NDArray[np.float64], contacts: Contacts, side: float, smooth: float
) -> NDArray[np.intp]:
    """Unite surfaces 1...K as long as the energy falls, those first by which it falls most.

    The energy is that of eq. 5.3; `side` is what the length of borders costs, `smooth` is
    `SensorModel.distortion_pixels`. Returns the roots. The contacts are used up.
    """
    moments, parent = moments.copy(), np.arange(len(moments))
    residual = _residuals(moments)
    length, target = contacts.length, contacts.target
    # Of contacts: by how much the energy changes if the two unite. Of each surface: the
    # contact with a later one by which it falls most, and by how much.
    change = np.zeros(len(length))
    nearest, least = np.full(len(moments), -1), np.zeros(len(moments))
    for e in range(len(length)):
        a, b = min(target[2 * e], target[2 * e + 1]), max(target[2 * e], target[2 * e + 1])
        change[e] = _energy_change(moments, residual, a, b, smooth) - side * length[e]
    for a in range(len(moments)):
        nearest[a], least[a] = least_contact(contacts, change, a, 0.0)
    while True:
        a, falls = _smallest(least)
        if not falls < 0:
            break
        b = target[nearest[a]]
        parent[b], least[b] = a, 0
        residual[a] = common_residual(moments, a, b)
        moments[a] += moments[b]
        absorb(contacts, change, a, b)
        h = contacts.head[a]
        while h >= 0:
            c = target[h]
            apart = _energy_change(moments, residual, a, c, smooth)
            change[h // 2] = apart - side * length[h // 2]
            nearest[c], least[c] = least_contact(contacts, change, c, 0.0)
            h = contacts.link[h]
        nearest[a], least[a] = least_contact(contacts, change, a, 0.0)
    return find_roots(parent)


@njit(cache=True)
def _residuals(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Chi-squared that the plane of each of some moments leaves."""
    theta = np.zeros(3)
    residual = np.zeros(len(moments))
    for a in range(len(moments)):
        residual[a] = fit(moments[a], theta)
    return residual


@njit(cache=True)
def _energy_change(
    moments: NDArray[np.float64], residual: NDArray[np.float64], a: int, b: int, smooth: float
) -> float:
    """What one plane costs the pixels of two surfaces beyond their own planes."""
    extra = common_residual(moments, a, b) - residual[a] - residual[b]
    # The distortion that a region so large is granted, as in `Models`.
    pixels = moments[a, COUNT] + moments[b, COUNT]
    granted = 1 + (moments[a, RATIO] + moments[b, RATIO]) / (pixels + smooth)
    return 0.5 * extra / granted


@njit(cache=True)
def _smallest(values: NDArray[np.float64]) -> tuple[int, float]:
    """The smallest of some values: its index, the first of equals, and itself."""
    index, smallest = 0, values[0]
    for k in range(1, len(values)):
        if values[k] < smallest:
            index, smallest = k, values[k]
    return index, smallest
