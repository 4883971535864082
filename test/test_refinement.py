"""Planes as labels: energy, descent and expansions against literal sums and exhaustive search."""

from itertools import product

import numpy as np
import pytest

from rangeseg_ros import Camera, Config, RangeImage
from rangeseg_ros.core.by_planes import labelling as refinement
from rangeseg_ros.core.by_planes.labelling import refine
from rangeseg_ros.core.by_planes.offsets import Offsets, offset_at
from rangeseg_ros.core.by_planes.patches import Nodes, find_patches
from rangeseg_ros.core.by_planes.plane_energy import Models, Problem, costs
from rangeseg_ros.core.by_planes.surfaces import join_surfaces
from rangeseg_ros.core.graphcut.expansion import GridLabelling, energy, fronts, minimise
from rangeseg_ros.core.regions import connected_components
from rangeseg_ros.core.sensing.grid import Grid, View, grid_of
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera

NOISE = 0.002
BLOCK = 2
LAMBDA = Config().plane_smoothness
SENSOR = SensorModel.from_config(Config(noise=NOISE, distortion=0.003))


def random_case(seed, height, width, count=3):
    """Problem with holes and cut edges whose pixels lie near one of `count` random planes."""
    random = np.random.default_rng(seed)
    rays = Camera(width, height, 20.0, 20.0, width / 2, height / 2).rays
    theta = random.normal([0, 0, 0.5], [0.02, 0.02, 0.006], (count + 1, 3))
    theta[0] = 0
    nearest = random.integers(1, count + 1, (height, width))
    inverse = (theta[nearest] * rays).sum(axis=2) + random.normal(0, 4 * NOISE, (height, width))
    inverse[random.random((height, width)) < 0.1] = 0
    image = RangeImage(rays, inverse.astype(np.float32))
    edges = grid_of(image)
    for edge in edges:
        edge &= random.random(edge.shape) < 0.8
    # Half of chi-squared, one to four variances granted.
    half_precision = 0.5 / np.concatenate([[1.0], random.uniform(1, 4, count)])
    box = np.array([[0, 0, 0, 0]] + count * [[0, 0, -(-height // BLOCK), -(-width // BLOCK)]])
    area = box[:, 2] * box[:, 3]
    shift = random.normal(0, 0.004, area.sum()).astype(np.float32)
    models = Models(theta, half_precision, Offsets(box, np.cumsum(area) - area, shift))
    labels = np.where(image.valid, random.integers(0, count + 1, (height, width)), 0)
    problem = Problem.of(image, SENSOR, edges, LAMBDA)
    # The rays are those of a pinhole camera, whether that is known or not.
    return problem._replace(pinhole=seed % 2 == 1), models, labels.astype(np.int32)


def unary(problem, models):
    """Cost (K + 1, H, W) of every label at every pixel, from the definition."""
    pixels = np.ndindex(len(problem.rays) // problem.width, problem.width)
    blocks, labels = [(i // BLOCK, j // BLOCK) for i, j in pixels], range(len(models.theta))
    shift = [[offset_at(models.offsets, label, *block) for block in blocks] for label in labels]
    residual = problem.inverse - (1 + np.array(shift)) * (models.theta @ problem.rays.T)
    cost = np.minimum(residual**2 * problem.weight * models.half_precision[:, None], 8.0)
    cost[0] = 10.8276 / 2  # chi-squared of one degree of freedom, quantile 0.999
    return np.where(problem.weight > 0, cost, 0).reshape(len(cost), -1, problem.width)


def prior(problem):
    """Costs of unlike labels to the right (H, W-1) and below (H-1, W)."""
    right, down = problem.links.reshape(2, -1, problem.width)
    return right[:, :-1], down[:-1]


def energy_of(labels, problem, models):
    """As results have it."""
    data, shape = costs(labels.ravel(), problem, models), (-1, problem.width)
    return energy(data.reshape(shape), labels.reshape(shape), problem.links)


def cost_of(labels, problem, models):
    cost = np.take_along_axis(unary(problem, models), labels[None].astype(int), 0)[0]
    return cost.astype(np.float32)


def energies(many, problem, models):
    """Energies (n,) of labellings (n, H, W), from the definition."""
    rows, columns = np.indices(many.shape[1:])
    total = unary(problem, models)[many, rows, columns].sum(axis=(1, 2))
    horizontal, vertical = prior(problem)
    total += ((many[:, :, 1:] != many[:, :, :-1]) * horizontal).sum(axis=(1, 2))
    return total + ((many[:, 1:] != many[:, :-1]) * vertical).sum(axis=(1, 2))


def expand(alpha, labels, cost, problem, models, reach=12):
    """Expand a label from everywhere; in place."""
    labels, cost = labels.ravel(), cost.ravel()
    rows = 0, len(labels) // problem.width
    labelling = GridLabelling.of(labels, cost, problem.links, problem.width)
    start, sites = fronts(labelling, len(models.theta), rows)
    front = sites[start[alpha] : start[alpha + 1]]
    refinement._expand(alpha, front, rows, reach, labelling, problem, models)
    assert (labelling.position == -1).all()


def linked(problem, label, labels):
    """Pixels (H, W) of other labels that edges join to those of a label, directly or not."""
    joined = Grid(*(links > 0 for links in prior(problem)))
    part = connected_components(np.zeros_like(labels), joined, np.ones(labels.shape, bool))
    return np.isin(part, part[labels == label]) & (labels != label)


def test_the_less_new_each_pixel_tells_the_more_unlike_labels_cost():
    image = RangeImage(np.ones((5, 6, 3), np.float32), np.ones((5, 6), np.float32))
    sensors = SENSOR, SENSOR._replace(correlation=0.0)
    links, of_white = (Problem.of(image, each, grid_of(image), LAMBDA).links for each in sensors)
    assert SENSOR.pixel_inflation > 2 and sensors[1].pixel_inflation == 1
    np.testing.assert_allclose(links, SENSOR.pixel_inflation * of_white, rtol=1e-6)
    assert of_white.max() == pytest.approx(LAMBDA)


@pytest.mark.parametrize('seed', range(20))
def test_an_expansion_is_the_best_there_is(seed):
    """Of all subsets of the pixels that edges join to the label."""
    problem, models, labels = random_case(seed, 3, 4)
    labels[0, 0], problem.inverse[0] = 1, models.theta[1] @ problem.rays[0]
    problem.weight[0] = problem.weight.max()
    # What is not known is worked out where it is asked for.
    cost = np.where(labels == 2, np.float32(np.nan), cost_of(labels, problem, models))
    free = np.flatnonzero(linked(problem, 1, labels))
    chosen = np.array(list(product([False, True], repeat=len(free))))
    every = np.repeat(labels.reshape(1, -1), len(chosen), axis=0)
    every[:, free] = np.where(chosen, 1, every[:, free])
    least = energies(every.reshape(-1, 3, 4), problem, models).min()
    before = labels.copy()
    expand(1, labels, cost, problem, models)
    (reached,) = energies(labels[None], problem, models)
    assert reached == pytest.approx(least, abs=1e-4)
    assert energy_of(labels, problem, models) == pytest.approx(reached, rel=1e-5)
    np.testing.assert_array_equal(problem.weight > 0, problem.inverse > 0)
    assert ((labels == before) | (labels == 1)).all()
    assert not labels.ravel()[problem.weight == 0].any()
    known = ~np.isnan(cost)
    assert known[free // 4, free % 4].all()
    np.testing.assert_allclose(cost[known], cost_of(labels, problem, models)[known], atol=1e-4)


def test_blocks_without_a_surface_begin_with_the_best_around_them():
    problem, models, labels = random_case(0, 2 * BLOCK, 4 * BLOCK)
    surfaces = np.array([[1, 0, 3, 2], [1, 0, 3, 2]], np.int32)
    labels, data = labels.ravel(), np.zeros(labels.size, np.float32)
    refinement._label_blocks(0, 2, surfaces, labels, data, problem, models)
    cost = unary(problem, models)
    best = np.where(cost[1] < cost[3], 1, 3) * (np.minimum(cost[1], cost[3]) < cost[0])
    expected = surfaces.repeat(BLOCK, 0).repeat(BLOCK, 1)
    expected = np.where(expected > 0, expected, best) * (cost[0] > 0)
    np.testing.assert_array_equal(labels, expected.ravel())


def test_a_label_is_expanded_as_far_as_it_gains():
    """Beyond the band around its borders, too."""
    problem, models, labels = random_case(0, 30, 40)
    problem.inverse[:], problem.weight[:] = problem.rays @ models.theta[1], problem.weight.max()
    models.theta[2, 2] += 0.1
    labels[:], labels[7, 9] = 2, 1
    gained = linked(problem, 1, labels)
    unknown = np.full(labels.shape, np.nan, np.float32)
    expand(1, labels, unknown, problem, models._replace(offsets=Offsets.none(4)), reach=2)
    gained[7, 9] = True
    np.testing.assert_array_equal(labels == 1, gained)


def test_the_energy_is_nearly_that_of_expansions_to_all_pixels():
    """Of every label, from anywhere, until none helps."""
    frame = simulate(kinect_room(900), Kinect(0), kinect_camera(160, 120), seed=900)
    image = RangeImage.from_depth(frame.depth, frame.camera)
    sensor = SensorModel.from_config(Config(pixel_noise=0.0))
    edges = grid_of(image)
    view = View(image, image, edges, sensor, 1, image.pixel_area, True)
    nodes = Nodes.of(view)
    surface, moments = join_surfaces(*find_patches(nodes, sensor), nodes, view, LAMBDA)
    problem = Problem.of(image, sensor, edges, LAMBDA)
    labels, models = refine(problem, surface, nodes.moments, moments, sensor)
    cost = unary(problem, models).reshape(len(models.theta), -1).astype(np.float32)
    everywhere, data = labels.copy(), cost[labels, np.arange(len(labels))]
    labelling = GridLabelling.of(everywhere, data, problem.links, problem.width)
    minimise(labelling, len(cost), lambda k, pixels: cost[k, pixels])
    least = energy_of(everywhere, problem, models)
    assert least <= energy_of(labels, problem, models) < 1.05 * least
