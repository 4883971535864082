"""The Kinect model: shadows, quantisation, and the statistics measured on real frames."""

import numpy as np
import pytest

from rangeseg_ros.simulation import scenes
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import Pose, Scene
from rangeseg_ros.simulation.sensors.kinect import (
    BASELINE,
    NOISES,
    QUANTUM,
    kinect_camera,
)
from rangeseg_ros.simulation.solids import box, half_space


def in_camera_frame(*solids):
    return Scene(solids, (Pose(np.eye(3), np.zeros(3)),))


def wall(z, tilt=0.0):
    angle = np.radians(tilt)
    return in_camera_frame(half_space((0, np.sin(angle), -np.cos(angle)), (0, 0, z)))


@pytest.mark.parametrize('noise', NOISES)
def test_shadow_lies_left_of_the_occluder_and_is_as_wide_as_parallax(noise):
    near, far = 1.0, 2.0
    plate = box((0.4, 0.4, 0.01), np.eye(3), (0, 0, near + 0.005))
    scene = in_camera_frame(half_space((0, 0, -1), (0, 0, far)), plate)
    frame = simulate_kinect(scene, noise=noise)
    row = frame.depth[240] > 0
    row[-8:] = True
    (hole,) = np.nonzero(~row)
    left = np.nonzero(frame.labels[240] == frame.labels[240, 320])[0][0]
    assert hole[-1] == left - 1
    assert (np.diff(hole) == 1).all()
    # Real sensors leave three quarters of it blank.
    share = 0.75 if noise == 'measured' else 1.0
    width = share * 585 * BASELINE * (1 / near - 1 / far)
    # Pixels less than a half behind what is before them are one surface at a grazing angle.
    assert abs(len(hole) + 0.5 - width) <= 1
    assert (frame.labels[240, hole] == 0).all()


def test_without_noise_depth_is_exact():
    frame = simulate_kinect(wall(2.5), noise='none')
    assert frame.depth.dtype == np.float32
    assert (frame.depth == np.float32(2.5)).all()
    assert (frame.labels == 1).all()
    (plane,) = frame.planes
    assert plane.normal.tolist() == [0, 0, -1]
    assert plane.distance == 2.5


@pytest.mark.parametrize('noise', ['measured', 'correlated', 'independent'])
def test_depth_takes_only_the_values_of_quantised_disparity(noise):
    frame = simulate_kinect(scenes.kinect_room(0), kinect_camera(320, 240), noise=noise)
    assert frame.depth.dtype == np.uint16
    steps = np.arange(1, 2000)
    possible = np.rint(1000 / (QUANTUM * steps))
    assert np.isin(frame.depth[frame.depth > 0], possible).all()


@pytest.mark.parametrize('z', [1.0, 3.0])
@pytest.mark.parametrize('noise', ['independent', 'correlated'])
def test_textbook_noise(z, noise):
    # Tilted, so that every phase of the quantisation occurs.
    true = simulate_kinect(wall(z, 20), noise='none').depth.astype(float)
    error = simulate_kinect(wall(z, 20), noise=noise, seed=3).depth / 1000 - true
    quantisation = QUANTUM * true**2 / np.sqrt(12)
    expected = np.hypot(0.0012 + 0.0019 * (true - 0.4) ** 2, quantisation)
    # 300,000 pixels, or 20,000 independent ones when correlated.
    assert (error / expected).std() == pytest.approx(1, abs=0.03)
    assert (error / expected).mean() == pytest.approx(0, abs=0.03)


@pytest.mark.parametrize('sigma', [None, (2.0, 2.0), (3.0, 8.0)])
def test_smooth_field_has_unit_variance_up_to_the_border(sigma):
    random = np.random.default_rng(0)
    fields = np.array([smooth_field((40, 30), sigma, random) for _ in range(400)])
    assert fields.std() == pytest.approx(1, rel=0.03)
    assert fields[:, 0].std() == pytest.approx(1, rel=0.1)
    assert fields[:, :, -1].std() == pytest.approx(1, rel=0.1)
    if sigma:
        # The autocorrelation of a smoothed field is the kernel convolved with itself.
        along = [(fields[..., 0] * fields[..., k]).mean() for k in range(6)]
        assert along == pytest.approx(np.exp(-((np.arange(6) / sigma[0] / 2) ** 2)), abs=0.06)
