"""Pieces of an image and their labelling, against sums over pixels and exhaustive search."""

import json
import os
import subprocess
import sys

import cv2
import numpy as np
import pytest

from rangeseg_ros.core.by_normals import coarse_to_fine
from rangeseg_ros.core.by_normals.angles import UNIT, angle
from rangeseg_ros.core.by_normals.directions import directions
from rangeseg_ros.core.by_normals.piece_moves import relabel_regions
from rangeseg_ros.core.by_normals.pieces import STAIRCASE_FACTOR, pieces
from rangeseg_ros.core.by_normals.tiles import TILE
from rangeseg_ros.core.sensing.grid import Grid

DIRECTIONS = directions('platonic', 73)


def problem(seed, height=45, width=61, smoothness=40.0):
    """Noisy patches with holes, cut by edges of random weight, many of them 0."""
    random = np.random.default_rng(seed)
    coarse = random.integers(0, len(DIRECTIONS), (height // 9 + 1, width // 9 + 1))
    truth = DIRECTIONS[coarse.repeat(9, 0).repeat(9, 1)[:height, :width]]
    normals = truth + 0.15 * random.normal(size=truth.shape)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    normals[random.random((height, width)) < 0.1] = np.nan
    horizontal = random.choice([0.0, 0.5, 1.0], (height, width - 1), p=[0.3, 0.2, 0.5])
    vertical = random.choice([0.0, 0.5, 1.0], (height - 1, width), p=[0.3, 0.2, 0.5])
    grid = Grid(horizontal.astype(np.float32), vertical.astype(np.float32))
    return normals.astype(np.float32), DIRECTIONS, grid, smoothness


@pytest.mark.parametrize('seed', range(5))
def test_pieces_are_connected_parts_of_tiles(seed):
    normals, _, (horizontal, vertical), _ = arguments = problem(seed)
    image = pieces(*arguments).image
    alone = np.ones(image.shape, bool)
    alone[:, 1:] &= horizontal == 0
    alone[:, :-1] &= horizontal == 0
    alone[1:] &= vertical == 0
    alone[:-1] &= vertical == 0
    assert np.array_equal(image < 0, alone & np.isnan(normals[..., 0]))
    for piece in range(image.max() + 1):
        rows, columns = np.nonzero(image == piece)
        assert len(set(rows // TILE)) == len(set(columns // TILE)) == 1
        reached, last = {(rows[0], columns[0])}, set()
        while reached != last:
            last = set(reached)
            for y, x in last:
                for b, a in ((y, x + 1), (y, x - 1), (y + 1, x), (y - 1, x)):
                    if not (0 <= b < image.shape[0] and 0 <= a < image.shape[1]):
                        continue
                    u = horizontal[y, min(a, x)] if b == y else vertical[min(b, y), x]
                    if u > 0 and image[b, a] == piece:
                        reached.add((b, a))
        assert len(reached) == len(rows)


@pytest.mark.parametrize('seed', range(3))
def test_links_are_sums_over_the_borders_and_costs_over_the_pixels(seed):
    normals, found, (horizontal, vertical), smoothness = arguments = problem(seed)
    parts = pieces(*arguments)
    image, count = parts.image, len(parts.votes)
    links = np.zeros((count, count))
    for weight, one, other in (
        (horizontal, image[:, :-1], image[:, 1:]),
        (vertical, image[:-1], image[1:]),
    ):
        border = (weight > 0) & (one != other)
        np.add.at(
            links, (one[border], other[border]), STAIRCASE_FACTOR * smoothness * weight[border]
        )
    links += links.T
    listed, graph = np.zeros_like(links), parts.graph
    for p in range(count):
        for e in range(graph.start[p], graph.start[p + 1]):
            q = graph.neighbours[e]
            assert listed[p, q] == 0
            listed[p, q] = graph.links[e]
    np.testing.assert_allclose(listed, links, rtol=1e-5)
    inside, sizes = image >= 0, np.bincount(image[image >= 0], minlength=count)
    for k in (0, 17, 72):
        each = angle(np.moveaxis(normals, 2, 0), found[k].astype(np.float32))
        total = np.bincount(image[inside], each[inside], count)
        # Half the diagonal of a cell, 2 / 128 wide in the octahedron, is 1.9 degrees where the
        # octahedron is nearest to the sphere's centre; half a unit is 0.125.
        assert (np.abs(UNIT * parts.costs[:, k] - total) <= 2.03 * sizes).all()


def value(parts, labels):
    data = UNIT * parts.costs[np.arange(len(labels)), labels].astype(float)
    graph = parts.graph
    one = np.repeat(np.arange(len(labels)), np.diff(graph.start))
    return data.sum() + graph.links[labels[one] != labels[graph.neighbours]].sum(dtype=float) / 2


@pytest.mark.parametrize('seed', range(10))
def test_relabelling_lowers_the_energy_and_ends(seed):
    parts = pieces(*problem(seed))
    labels = parts.votes.copy()
    relabel_regions(labels, parts.costs, parts.graph)
    assert value(parts, labels) < value(parts, parts.votes)
    again = labels.copy()
    relabel_regions(again, parts.costs, parts.graph)
    np.testing.assert_array_equal(again, labels)


@pytest.mark.parametrize('seed', range(10))
def test_regions_take_the_best_label_of_all(seed):
    parts = pieces(*problem(seed))
    settled, graph = parts.votes.copy(), parts.graph
    relabel_regions(settled, parts.costs, graph)
    best = value(parts, settled)
    # Each connected piece of a label, grown from a few seeds.
    for seed_piece in range(0, len(settled), 7):
        region, front = {seed_piece}, [seed_piece]
        while front:
            p = front.pop()
            for q in graph.neighbours[graph.start[p] : graph.start[p + 1]]:
                if q not in region and settled[q] == settled[p]:
                    region.add(q)
                    front.append(q)
        for label in range(len(DIRECTIONS)):
            trial = settled.copy()
            trial[list(region)] = label
            assert value(parts, trial) >= best - 0.1


def labels_of_a_small_problem():
    arguments = problem(3, 30, 40)
    return coarse_to_fine.minimise(*arguments).ravel().tolist()


def test_compiled_code_gives_the_labels_of_the_plain_python():
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path), 'NUMBA_DISABLE_JIT': '1'}
    text = subprocess.check_output([sys.executable, __file__], env=environment, text=True)
    assert json.loads(text) == labels_of_a_small_problem()


def test_number_of_threads_does_not_matter():
    arguments = problem(5, 120, 90)
    before = cv2.getNumThreads()
    try:
        found = []
        for threads in (1, 2):
            cv2.setNumThreads(threads)
            found.append(coarse_to_fine.minimise(*arguments))
    finally:
        cv2.setNumThreads(before)
    assert np.array_equal(*found)


if __name__ == '__main__':
    print(json.dumps(labels_of_a_small_problem()))
