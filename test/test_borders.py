"""Borders of regions, against a look at every pixel and edge."""

import numpy as np
import pytest

from rangeseg_ros.core.fitting.borders import find_borders
from rangeseg_ros.core.regions import drop_regions
from rangeseg_ros.core.sensing.grid import Grid


def regions_of(seed):
    """Regions of a few pixels up to whole rows, one number without any."""
    random = np.random.default_rng(seed)
    height, width = random.integers(1, 40, 2)
    regions = np.kron(random.integers(0, 6, (height, width)), np.ones((3, 5), int))
    regions[random.random(regions.shape) < 0.02] = 7
    return regions[: height + 2, : 2 * width + 3].astype(np.uint16), random


def grid_of(regions, random):
    height, width = regions.shape
    return Grid(
        random.integers(0, 2, (height, width - 1)).astype(np.float32),
        random.integers(0, 2, (height - 1, width)).astype(np.float32),
    )


@pytest.mark.parametrize('seed', range(20))
def test_borders_are_those_of_every_pixel(seed):
    regions, random = regions_of(seed)
    grid = grid_of(regions, random)
    borders = find_borders(regions, grid, 9)
    framed = np.pad(regions, 1)
    for k in range(1, 9):
        rows, columns = np.nonzero(regions == k)
        box = [min(rows), min(columns), max(rows) + 1, max(columns) + 1] if len(rows) else [0] * 4
        assert borders.box[k].tolist() == box
        sides = (framed[1:] != framed[:-1]) & ((framed[1:] == k) | (framed[:-1] == k))
        ends = (framed[:, 1:] != framed[:, :-1]) & ((framed[:, 1:] == k) | (framed[:, :-1] == k))
        assert borders.length[k] == sides.sum() + ends.sum()
    met = {}
    for here, there, linked in (
        (regions[:, :-1], regions[:, 1:], grid.right),
        (regions[:-1], regions[1:], grid.below),
    ):
        for k, m, link in zip(here.ravel(), there.ravel(), linked.ravel(), strict=True):
            if k != m and min(k, m) > 0:
                for pair in ((int(k), int(m)), (int(m), int(k))):
                    links, cuts = met.get(pair, (0, 0))
                    met[pair] = links + int(link > 0), cuts + int(link == 0)
    found = {}
    for k in range(9):
        own = slice(borders.start[k], borders.start[k + 1])
        others = borders.other[own].tolist()
        assert others == sorted(set(others))
        counts = zip(borders.links[own].tolist(), borders.cuts[own].tolist(), strict=True)
        found.update({(k, m): count for m, count in zip(others, counts, strict=True)})
    assert found == met
    assert borders.start[-1] == len(borders.other)


@pytest.mark.parametrize('seed', range(20))
def test_borders_without_some_regions_are_those_of_the_others(seed):
    regions, random = regions_of(seed)
    grid, dropped = grid_of(regions, random), random.random(9) < 0.3
    dropped[0] = False
    kept = find_borders(drop_regions(regions, dropped), grid, np.count_nonzero(~dropped))
    found = find_borders(regions, grid, 9).without(dropped)
    # What ends region 0 are the others.
    np.testing.assert_array_equal(found.box[1:], kept.box[1:])
    np.testing.assert_array_equal(found.length[1:], kept.length[1:])
    for own, other in zip(found[2:], kept[2:], strict=True):
        np.testing.assert_array_equal(own, other)
        assert own.dtype == other.dtype
