"""A share of the full work: what it leaves out, and what it must not."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from clouds import cloud_of

from rangeseg_ros import Camera, Config, RangeImage, Segmenter
from rangeseg_ros.core.by_planes.upsampling import labels_of_all
from rangeseg_ros.core.options import ConfigError
from rangeseg_ros.core.runtime.work import Work
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance
from rangeseg_ros.core.significance import chi2_quantile
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

BUDGETS = (1.0, 0.97, 0.95, 0.8, 0.67, 0.65, 0.0)


@pytest.fixture(scope='module')
def room():
    camera = kinect_camera(321, 241)
    return simulate_kinect(kinect_room(2), camera, seed=2), camera


@pytest.fixture(scope='module')
def image(room):
    return RangeImage.from_depth(room[0].depth, room[1])


@pytest.fixture(scope='module')
def results(image):
    return {budget: Segmenter(Config(work_budget=budget)).segment(image) for budget in BUDGETS}


def test_less_is_never_more():
    steps = [Work.within(budget) for budget in np.linspace(1, 0, 1001)]
    assert steps[0] == (1, 1.0) and steps[-1] == (4, 0.0)
    assert {work.step for work in steps} == {1, 2, 4}
    for before, after in pairwise(steps):
        assert before.step <= after.step
        assert before.cuts >= after.cuts or before.step < after.step


def test_fewer_cuts_leave_more_energy(results):
    energies = [results[budget].energy for budget in (1.0, 0.97, 0.95)]
    assert energies[0] < energies[1] < energies[2]
    energies = [results[budget].energy for budget in (0.8, 0.67, 0.65)]
    assert energies[0] < energies[1] < energies[2]


@pytest.mark.parametrize('budget', BUDGETS)
def test_results_do_not_depend_on_the_number_of_threads(image, results, budget):
    before = cv2.getNumThreads()
    try:
        for threads in (1, 3):
            cv2.setNumThreads(threads)
            again = Segmenter(Config(work_budget=budget)).segment(image)
            assert (again.labels == results[budget].labels).all()
    finally:
        cv2.setNumThreads(before)


@pytest.mark.parametrize('budget', BUDGETS)
def test_planes_are_those_of_the_scene(image, room, results, budget):
    """Every wall, floor and ceiling of a twelfth of the image is found, its pixels too."""
    result, truth = results[budget], room[0].labels
    assert result.labels.shape == result.edges.shape == image.shape
    assert not result.labels[~image.valid].any()
    counts = [np.count_nonzero(result.labels == plane.label) for plane in result.planes]
    assert counts == [plane.count for plane in result.planes]
    for label in np.unique(truth[truth > 0]):
        region = (truth == label) & image.valid
        if np.count_nonzero(region) < image.valid.size / 12:
            continue
        found = np.bincount(result.labels[region])
        best = result.labels == found[1:].argmax() + 1
        assert (best & region).sum() > 0.85 * (best | region).sum()


def test_the_sensor_is_said_in_pixels_of_the_image(results):
    full, coarse = results[1.0].sensor, results[0.8].sensor
    assert coarse.noise == pytest.approx(full.noise, rel=0.5)
    # Half of an odd number of rows is rounded up.
    assert coarse.distortion_length == pytest.approx(full.distortion_length, rel=0.01)


def labels_by_hand(few, step, image, whole, theta, sensor, smoothness):
    """Of each pixel, the label around it of the least energy, the upper left one first."""
    regions = np.zeros(whole.shape, np.uint16)
    for row, column in np.argwhere(whole.inverse > 0):
        y = whole.inverse[row, column]
        variance = random_variance(sensor, y**2) + systematic_variance(sensor, y**2)
        around = [
            (i, j)
            for j in (column // step, min(-(-column // step), few.shape[1] - 1))
            for i in (row // step, min(-(-row // step), len(few) - 1))
        ]
        known = [few[i, j] for i, j in around if whole.inverse[i * step, j * step] > 0]
        costs = {}
        for i, j in around:
            label = few[i, j]
            residual = y - theta[label] @ whole.rays[row, column]
            data = min(residual**2 / variance / 2, 8) if label else chi2_quantile(1) / 2
            unlike = np.mean([other != label for other in known]) if known else 0
            costs[label] = data + 4 * smoothness * unlike
        regions[row, column] = min(costs, key=costs.get)
    labels = regions * (image.inverse > 0).astype(np.uint16)
    counts = np.bincount(labels.ravel(), minlength=len(theta))
    counts[0] = 0
    return regions, labels, counts


@pytest.mark.parametrize('step', [2, 4])
@pytest.mark.parametrize('shape', [(1, 1), (8, 9), (13, 22), (20, 75)])
@pytest.mark.parametrize('kinds', [1, 4])
def test_pixels_between_take_the_label_of_the_least_energy(shape, step, kinds):
    draw = np.random.default_rng(7)
    camera = Camera(shape[1], shape[0], 20.0, 20.0, shape[1] / 2, shape[0] / 2)
    theta = np.vstack([np.zeros(3), draw.normal((0, 0, 0.5), 0.01, (3, 3))])
    few = draw.integers(4 - kinds, 4, (-(-shape[0] // step), -(-shape[1] // step)))
    few = few.astype(np.uint16)
    few[:, -12:] = 1
    truth = draw.integers(1, 4, shape)
    inverse = (theta[truth] * camera.rays).sum(axis=2).astype(np.float32)
    inverse[draw.random(shape) < 0.1] = 0
    whole = RangeImage(camera.rays, inverse, camera)
    # As of a cloud, which has rays where something was measured.
    measured = (inverse > 0) & (draw.random(shape) > 0.1)
    image = RangeImage(camera.rays * measured[..., None], inverse * measured)
    sensor = SensorModel.from_config(Config(noise=0.003, distortion=0.002))
    told = few, step, image, whole, theta, sensor, 0.7
    for found, expected in zip(labels_of_all(*told), labels_by_hand(*told), strict=True):
        np.testing.assert_array_equal(found, expected)


def overlap(labels, truth, valid):
    """Mean IoU of the regions of at least 1000 pixels."""
    found = []
    for face in np.unique(truth[truth > 0]):
        region = (truth == face) & valid
        if np.count_nonzero(region) >= 1000:
            best = labels == np.bincount(labels[region], minlength=2)[1:].argmax() + 1
            found.append(np.count_nonzero(best & region) / np.count_nonzero(best & valid | region))
    return np.mean(found)


@pytest.mark.parametrize(('budget', 'loss'), [(0.8, 0.005), (0.0, 0.03)])
def test_borders_are_found_among_the_pixels_left_out(room, image, results, budget, loss):
    """A border that keeps to the rows and columns looked at costs three times as much."""
    full, less = (overlap(results[b].labels, room[0].labels, image.valid) for b in (1.0, budget))
    assert less > full - loss


def test_no_jump_beside_what_was_not_measured(image, results):
    across, down = results[0.8].jumps
    valid = image.valid
    assert across.any() and down.any()
    assert not (across & ~(valid[:, 1:] & valid[:, :-1])).any()
    assert not (down & ~(valid[1:] & valid[:-1])).any()


@pytest.mark.parametrize(('step', 'shape'), [(2, (3, 4)), (4, (2, 2))])
def test_a_coarser_camera_sees_every_second_or_fourth_pixel(step, shape):
    camera = Camera(7, 5, 6.0, 6.5, 3.2, 1.9, skew=0.3)
    assert camera.every(step).shape == shape
    assert camera.every(step).rays == pytest.approx(camera.rays[::step, ::step], abs=1e-6)


def test_clouds_and_bodies_are_halved(image):
    cloud = cloud_of(image.points)
    budget = Config(work_budget=0.7)
    result = Segmenter(budget).segment(cloud)
    assert result.labels.shape == image.shape and result.planes
    body = np.zeros(image.shape, bool)
    body[150:] = True
    hidden = Segmenter(budget).segment(image.without(body))
    assert hidden.planes and not hidden.labels[body].any()


@pytest.mark.parametrize('shape', [(1, 1), (1, 9), (2, 3), (5, 1)])
def test_tiny_images(shape):
    height, width = shape
    camera = Camera(width, height, 5.0, 5.0, width / 2, height / 2)
    image = RangeImage.from_depth(np.full(shape, 1000, np.uint16), camera)
    assert Segmenter(Config(work_budget=0.7)).segment(image).labels.shape == shape


@pytest.mark.parametrize('other', [{'method': 'normals'}, {'exact': True}])
def test_budgets_are_for_the_shortcuts_of_planes(other):
    with pytest.raises(ConfigError, match='work_budget'):
        Config(work_budget=0.95, **other)
