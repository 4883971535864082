"""A share of the full work: what it leaves out, and what it must not."""

from itertools import pairwise

import numpy as np
import pytest
from clouds import cloud_of

from rangeseg_ros import Config, RangeImage, Segmenter
from rangeseg_ros.core.options import ConfigError
from rangeseg_ros.core.sensing.binning import STEPS, step_within
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

BUDGETS = (*STEPS, 0.0)


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
    steps = [step_within(budget) for budget in np.linspace(1, 0, 1001)]
    assert [step_within(budget) for budget in STEPS] == [1, 2, 4]
    assert steps[0] == 1 and steps[-1] == 4
    assert all(before <= after for before, after in pairwise(steps))


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
        # Of every fourth pixel borders are four pixels wide.
        least = 0.85 if budget > 0 else 0.7
        assert (best & region).sum() > least * (best | region).sum()


def test_clouds_and_bodies_are_halved(image):
    cloud = cloud_of(image.points)
    budget = Config(work_budget=0.7)
    result = Segmenter(budget).segment(cloud)
    assert result.labels.shape == image.shape and result.planes
    body = np.zeros(image.shape, bool)
    body[150:] = True
    hidden = Segmenter(budget).segment(image.without(body))
    assert hidden.planes and not hidden.labels[body].any()


def test_budgets_are_for_method_planes():
    with pytest.raises(ConfigError, match='work_budget'):
        Config(work_budget=0.95, method='normals')
