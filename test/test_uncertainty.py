"""Covariances of planes: against the exact sum over pairs of pixels, and against errors made."""

import numpy as np
import pytest
from planes_of_labels import fit_planes

from rangeseg_ros.core.fitting.uncertainty import plane_jacobians, sandwiches
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.sensors.kinect import QUANTUM

NORMAL, DISTANCE = np.array([0.36, -0.48, -0.8]), 2.0
# A region of 16 pixels tells its normal to ten degrees, where normal and distance are no longer
# linear in the errors: a twentieth of a Kinect's.
SMALL = 0.05


def part(x, y, width, height):
    """Camera that sees a part of a Kinect's image."""
    return Camera(width, height, 585.0, 585.0, 319.5 - x, 239.5 - y)


def inverse_range(camera):
    return -(camera.rays.astype(float) @ (NORMAL / DISTANCE))


def models(unit):
    """Sensors with errors of one kind, and of all."""
    return {
        'white': SensorModel(0.45 * unit, 0, 1.0, 2, 0, 0, 35),
        'correlated': SensorModel(0.45 * unit, 0, 0.0, 2, 0, 0, 35),
        'systematic': SensorModel(0.01 * unit, 0, 1.0, 2, 0.5 * unit, 0, 35),
        'all': SensorModel(0.45 * unit, 0, 0.33, 2, 0.5 * unit, 0, 35),
        'laser': SensorModel(0, 2 * unit, 0.2, 2, 0, 2 * unit, 20),
    }


def disc(height, width):
    return np.hypot(*np.ogrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]) < 1


def full(height, width):
    return np.ones((height, width), bool)


@pytest.mark.parametrize('kind', models(1))
@pytest.mark.parametrize(
    ('view', 'shape'),
    [
        ((400, 100, 16, 16), full),
        ((100, 300, 50, 8), full),
        ((300, 200, 60, 60), full),
        ((200, 200, 70, 50), disc),
    ],
    ids=['16x16', '50x8', '60x60', 'disc'],
)
def test_sums_over_cells_are_those_over_pixels(kind, view, shape):
    camera, sensor = part(*view), models(SMALL * QUANTUM)[kind]
    exact = inverse_range(camera)
    mask = shape(*camera.shape)
    image = RangeImage(camera.rays, exact.astype(np.float32), camera)
    (plane,) = fit_planes(mask.astype(np.uint16), image, sensor)

    rows, columns = np.nonzero(mask)
    squared = (rows[:, None] - rows) ** 2 + (columns[:, None] - columns) ** 2
    level = exact[mask] ** 4
    random = sensor.noise**2 + sensor.range_noise**2 * level
    systematic = sensor.distortion**2 + sensor.range_distortion**2 * level
    field = np.exp(-squared / 4 / sensor.correlation**2)
    field = sensor.white * np.eye(len(rows)) + (1 - sensor.white) * field
    errors = np.sqrt(np.outer(random, random)) * field
    field = np.exp(-squared / 4 / sensor.distortion_length**2)
    errors += np.sqrt(np.outer(systematic, systematic)) * field
    weighted = camera.rays[mask].astype(float) / random[:, None]
    inverse = np.linalg.inv(weighted.T @ camera.rays[mask])
    jacobian = plane_jacobians(NORMAL[None], np.array([DISTANCE]))[0]
    spread = jacobian @ inverse @ weighted.T
    truth = spread @ errors @ spread.T
    # In every direction, as a ratio of variances.
    directions = np.linalg.svd(jacobian)[0][:, :3]
    ratio = np.linalg.eigvals(
        np.linalg.solve(
            directions.T @ plane.covariance @ directions, directions.T @ truth @ directions
        )
    )
    # Errors are alike all over a cell, of which a strip of eight pixels has two across: there
    # they are said to turn the plane by more than they do.
    most = 1.15 if min(view[2:]) > 8 else 1.8
    assert ratio.real.min() > 0.85 and ratio.real.max() < most
    assert np.linalg.matrix_rank(plane.covariance, tol=1e-9 * np.trace(plane.covariance)) <= 3


@pytest.mark.slow
def test_covariance_tells_the_errors_of_the_simulated_kinect():
    """Correlated noise and distortion wider than high, in steps: per degree of freedom."""
    camera, random = part(200, 150, 100, 80), np.random.default_rng(4)
    exact, labels = inverse_range(camera), np.ones(camera.shape, np.uint16)
    sensor, squares = models(QUANTUM)['all'], []
    for _ in range(200):
        error = 0.37 * smooth_field(camera.shape, (2, 2), random)
        error += 0.5 * smooth_field(camera.shape, (26, 45), random)
        inverse = np.rint(exact / QUANTUM + error) * QUANTUM
        image = RangeImage(camera.rays, inverse.astype(np.float32), camera)
        (plane,) = fit_planes(labels, image, sensor)
        error = np.append(plane.normal - NORMAL, plane.distance - DISTANCE)
        precision = np.linalg.pinv(plane.covariance, rcond=1e-10, hermitian=True)
        squares.append(error @ precision @ error / 3)
    assert np.mean(squares) == pytest.approx(1, abs=0.2)


def test_no_variance_is_negative():
    """Three pixels nearly in a line as a fish-eye's corner sees them: A^-1 magnifies rounding."""
    camera = Camera(32, 63, 1.0, 0.3, 15.5, 31.0, 0.0, 'plumb_bob', (-0.2, 0.05, 0.001, 0, 0))
    labels = np.zeros(camera.shape, np.uint16)
    labels[0, 25:28] = 1
    depth = np.full(camera.shape, 2.5)
    depth[0, 25:28] = 2.48230966, 2.49894049, 2.48958973
    image = RangeImage.from_depth(depth, camera)
    (plane,) = fit_planes(labels, image, SensorModel(0, 0, 0.33, 2, 0.0014, 0, 7))
    values = np.linalg.eigvalsh(plane.covariance)
    assert values[0] > -1e-9 * values[-1]


@pytest.mark.parametrize('rank', [0, 1, 2, 3])
def test_no_variance_becomes_negative_where_a_covariance_is_magnified(rank):
    random = np.random.default_rng(rank)
    root = random.normal(size=(50, 3, rank)) * 10.0 ** random.uniform(-6, 6, (50, 1, rank))
    middle = root @ root.transpose(0, 2, 1)
    outer = random.normal(size=(50, 4, 3)) * 10.0 ** random.uniform(-3, 3, (50, 4, 1))
    found = sandwiches(outer, middle)
    along = outer @ root
    scale = np.linalg.norm(outer, axis=2) * np.linalg.norm(root, axis=(1, 2))[:, None]
    error = np.abs(found - along @ along.transpose(0, 2, 1))
    assert (error <= 1e-12 * scale[:, :, None] * scale[:, None, :]).all()
    assert (np.diagonal(found, axis1=1, axis2=2) >= 0).all()
    np.testing.assert_array_equal(found, found.transpose(0, 2, 1))
