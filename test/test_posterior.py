"""Planes are told from curved surfaces, whatever the sensor's distortion and flying pixels do."""

import numpy as np
import pytest

from rangeseg_ros.core.by_planes.posterior import _explained, plane_probabilities
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.sensors.kinect import QUANTUM

CAMERA = Camera(320, 240, 292.0, 292.0, 159.5, 119.5)
SENSOR = SensorModel.from_config(Config(), CAMERA.shape)
WALL = CAMERA.rays.astype(float) @ np.array([0.1, 0, 0.5])


def cylinder(radius, distance=2.0):
    """Inverse depth of a standing cylinder, 0 beside it."""
    x = CAMERA.rays[..., 0].astype(float)
    # Nearer root of (z x)^2 + (z - c)^2 = r^2.
    centre = distance + radius
    root = centre**2 - (1 + x**2) * (centre**2 - radius**2)
    depth = (centre - np.sqrt(np.maximum(root, 0))) / (1 + x**2)
    return np.where(root > 0, 1 / depth, 0)


def probabilities(inverse, regions, seed=0):
    random = np.random.default_rng(seed)
    error = 0.45 * smooth_field(CAMERA.shape, (2.0, 2.0), random)
    error += 0.5 * smooth_field(CAMERA.shape, (13.0, 22.0), random)
    seen = np.where(inverse > 0, inverse + QUANTUM * error, 0).astype(np.float32)
    fits = Fits.of(regions.astype(np.uint16), RangeImage(CAMERA.rays, seen, CAMERA), SENSOR)
    return plane_probabilities(fits, 0.5)


@pytest.mark.parametrize('seed', range(3))
def test_planes_that_the_sensor_bends_are_planes(seed):
    regions = np.ones(CAMERA.shape, int)
    regions[100:, :] = 2
    inverse = np.where(regions == 1, WALL, CAMERA.rays @ np.array([0, 0.4, 0.6]))
    assert (probabilities(inverse, regions, seed)[1:] > 0.5).all()


@pytest.mark.parametrize('radius', [0.3, 0.5])
@pytest.mark.parametrize('seed', range(2))
def test_cylinders_are_none(radius, seed):
    inverse = cylinder(radius)
    assert probabilities(inverse, inverse > 0, seed)[1] < 0.3


@pytest.mark.parametrize('seed', range(2))
def test_a_rim_of_another_surface_does_not_bend_a_plane(seed):
    """A tenth of the pixels, on one side: a region that spills over its border."""
    regions = np.zeros(CAMERA.shape, int)
    regions[60:180, 80:240] = 1
    inverse = WALL.copy()
    inverse[60:180, 224:240] += 10 * QUANTUM
    assert probabilities(inverse, regions, seed)[1] > 0.5


def test_what_tells_nothing_has_the_prior():
    regions = np.zeros(CAMERA.shape, int)
    regions[100, 100] = 1
    assert probabilities(WALL, regions).tolist() == [0.0, 0.5]


def test_what_a_quadratic_explains_is_what_least_squares_explain():
    random = np.random.default_rng(5)
    u, v, residual = random.uniform(-1, 1, (3, 200))
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    flat, whole = (
        (
            (terms[:, :count] @ np.linalg.lstsq(terms[:, :count], residual, rcond=None)[0]) ** 2
        ).sum()
        for count in (3, 6)
    )
    found = _explained(terms.T @ terms, terms.T @ residual)
    np.testing.assert_allclose(found, (flat, whole - flat), rtol=1e-6)
