"""Patches of blocks are agglomerated to planar surfaces (Feng, Taguchi and Kamat, ICRA 2014).

Two parts are one surface for either of two reasons. They agree: one plane explains both as well as
noise, distortion and the bend that planes have themselves let expect, and so it does the patches
along their border. Or one plane costs their pixels less than their common border does in the
energy that is minimised afterwards (thesis eq. 5.3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from rangeseg_ros.core.arrays import Floats, Indices, Ints, Labels, Mask
from rangeseg_ros.core.by_planes.patches import Nodes
from rangeseg_ros.core.by_planes.posterior import PLANE_BEND
from rangeseg_ros.core.by_planes.region_graph import (
    absorb,
    find_contacts,
    find_roots,
    make_sets,
    renumbered,
)
from rangeseg_ros.core.fitting.region_sums import RegionSums
from rangeseg_ros.core.regions import by_falling_size, relabel
from rangeseg_ros.core.sensing.blocks import NODE
from rangeseg_ros.core.sensing.grid import View
from rangeseg_ros.core.sensing.moments import CHI2, COUNT, RATIO, SIZE, common_residual, fit_all
from rangeseg_ros.core.sensing.sensor import distortion_share
from rangeseg_ros.core.significance import chi2_quantile

# By how much the squares that two parts leave of a common plane may exceed those that a smooth
# distortion lets expect, which has two parameters along a border: a step and a bend.
_WITHIN = chi2_quantile(2)
# What noise makes of the three parameters of a plane.
_NOISE = chi2_quantile(3)
# What a plane more costs at least: evidence that is no chance for its three parameters.
_PLANE = chi2_quantile(3) / 2


class Expected(NamedTuple):
    """What is expected of parts of one surface.

    Of the sensor `smooth`, its `distortion_pixels`, and two of its inflations. Lengths of borders
    are counted in `unit` pixels, of which each costs `border` in the energy. `bend` is the mean
    square by which planes bend per pixel of their size, over their squared inverse range.
    """

    smooth: float
    block_inflation: float
    pixel_inflation: float
    unit: float
    border: float
    bend: float

    @classmethod
    def of(cls, view: View, unit: int, smoothness: float) -> Expected:
        """Of parts of an image, their borders counted in units of so many pixels."""
        sensor, smooth = view.sensor, view.sensor.distortion_pixels
        border, bend = float(smoothness * sensor.pixel_inflation * unit), PLANE_BEND**2 * view.area
        inflation = sensor.block_inflation, sensor.pixel_inflation
        return cls(smooth, *inflation, float(unit), border, bend)


def join_surfaces(
    patches: Ints, moments: Floats, nodes: Nodes, view: View, smoothness: float
) -> tuple[Ints, Floats]:
    """Group the patches (rows, columns) of blocks, of moments (P + 1, 13), into planar surfaces.

    The surface of each block, 0 for none, otherwise 1...K, and moments (K + 1, 13). Those with
    fewer pixels than the whole blocks inside the `least` square plane of the view have, or than
    four blocks, are clutter.
    """
    expected = Expected.of(view, NODE, smoothness)
    roots, _ = _agglomerate(patches, nodes.right, nodes.below, moments, expected)
    least = max(view.min_pixels**0.5 - NODE, 2 * NODE) ** 2
    surface, moments = renumbered(roots, moments, least)
    return surface[patches], moments


def unite_regions(
    regions: Labels, sums: RegionSums, view: View, smoothness: float
) -> tuple[Labels, Labels, RegionSums]:
    """Unite regions (H, W) whose pixels touch, for the reasons for which patches are.

    Where holes or jumps leave no blocks beside each other, their pixels may still touch. Also
    returns the pairs (E, 2) of regions that touch, and the sums over the united ones.
    """
    moments, expected = sums.moments(view.sensor), Expected.of(view, 1, smoothness)
    roots, pairs = _agglomerate(regions.astype(np.int32), *view.grid, moments, expected)
    numbers = by_falling_size(np.bincount(roots, sums.pixels, len(roots)).astype(np.intp))[roots]
    return relabel(regions, numbers), numbers[pairs], sums.united(numbers)


@njit(cache=True, nogil=True)
def _agglomerate(
    labels: Ints, right: Mask, below: Mask, moments: Floats, expected: Expected
) -> tuple[Indices, Ints]:
    """Merge the parts 1...P of an image of labels, those that are likeliest one surface first.

    Returns the root (P + 1,) of each, and the pairs (E, 2) of parts that touch and are not merged.
    """
    contacts = find_contacts(labels, right, below, len(moments))
    moments, parent = moments.copy(), make_sets(len(moments))
    residual = fit_all(moments)[1]
    length, target = contacts.length, contacts.target
    # Of half-edges: moments of the patches along the border. Of contacts: how far two parts are
    # from one surface, 1 being too far; one more than there are, as there may be none.
    strips, apart = np.zeros((2 * len(length), SIZE)), np.full(len(length) + 1, np.inf)
    for e in range(len(length)):
        a, b = _parts(target, e)
        for h in range(2 * e, 2 * e + 2):
            part = target[h ^ 1]
            # The side of a square patch borders on one other, or on several in part.
            weight = min(1.0, length[e] * expected.unit / np.sqrt(moments[part, COUNT]))
            for k in range(SIZE):
                strips[h, k] = weight * moments[part, k]
        apart[e] = _apart(moments, residual, a, b, strips, 2 * e, length[e], expected)
    while True:
        e = int(apart.argmin())
        if not apart[e] < 1:
            break
        a, b = _parts(target, e)
        residual[a] = common_residual(moments, a, b)
        parent[b] = a
        for k in range(SIZE):
            moments[a, k] += moments[b, k]
        absorb(contacts, strips, apart, a, b)
        h = contacts.head[a]
        while h >= 0:
            c, e = int(np.intp(target[h])), h // 2
            apart[e] = _apart(moments, residual, a, c, strips, 2 * e, length[e], expected)
            h = contacts.link[h]
    return find_roots(parent), target.reshape(-1, 2)[length > 0]


@njit(cache=True)
def _parts(target: Ints, e: int) -> tuple[int, int]:
    """The parts of a contact, the earlier one first."""
    one, other = int(np.intp(target[2 * e])), int(np.intp(target[2 * e + 1]))
    return min(one, other), max(one, other)


@njit(cache=True)
def _apart(
    moments: Floats,
    residual: Floats,
    a: int,
    b: int,
    strips: Floats,
    h: int,
    length: float,
    expected: Expected,
) -> float:
    """How far two parts are from one surface, 1 being too far: by their fit, or by the energy.

    `strips` h and h + 1 are those along their border.
    """
    extra = common_residual(moments, a, b) - residual[a] - residual[b]
    pixels = moments[a, COUNT] + moments[b, COUNT]
    ratio = (moments[a, RATIO] + moments[b, RATIO]) / pixels
    granted = 1 + ratio * distortion_share(pixels, expected.smooth)
    change = (0.5 * extra / granted - expected.border * length) / expected.pixel_inflation
    costs, fits = 1 + change / _PLANE, _misfit(extra, moments, a, b, expected.bend, expected)
    if fits >= min(costs, 1):
        # However well the patches along the border fit.
        return costs
    own = (common_residual(strips, h, h) + common_residual(strips, h + 1, h + 1)) / 2
    crease = common_residual(strips, h, h + 1) - own
    # Deviations of an evenly curved surface grow as the length squared, their squares as area^2.
    near = expected.bend * (strips[h, COUNT] + strips[h + 1, COUNT]) / pixels
    return min(max(fits, _misfit(crease, strips, h, h + 1, near, expected)), costs)


@njit(cache=True)
def _misfit(
    extra: float, moments: Floats, k: int, m: int, bend: float, expected: Expected
) -> float:
    """What two parts leave of a common plane beyond their own, in what that may be at most."""
    first, second = moments[k, COUNT], moments[m, COUNT]
    pixels, smooth = first + second, expected.smooth
    ratio = (moments[k, RATIO] + moments[m, RATIO]) / pixels
    smoothly = pixels * distortion_share(pixels, smooth)
    smoothly -= first * distortion_share(first, smooth) + second * distortion_share(second, smooth)
    # Sums of squares of a bend grow as pixels^2: N^2 - n^2 - m^2 = 2 n m more than in the parts.
    bent = bend * (moments[k, CHI2] + moments[m, CHI2]) * 2 * first * second / pixels
    return extra / (_NOISE * expected.block_inflation + _WITHIN * (ratio * smoothly + bent))
