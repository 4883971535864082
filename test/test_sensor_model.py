"""The sensor's noise, as stated and as an image shows it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rangeseg_ros.core.by_planes.blocks import block_moments, residual_noise, slopes_and_residuals
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.grid import weights
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance

CAMERA = Camera(320, 240, 290.0, 290.0, 159.5, 119.5)
STATED = SensorModel.from_config(Config(noise=1e-5, range_noise=0.0))


def shown(noise, range_noise, outliers=0.0, seed=0):
    """What an image of three planes, 0.5 to 5 m away, shows of white noise."""
    random = np.random.default_rng(seed)
    inverse = CAMERA.rays @ np.array([0.1, 0.05, 1.2])
    inverse[80:] = CAMERA.rays[80:] @ np.array([0.05, -0.1, 0.7])
    inverse[160:] = CAMERA.rays[160:] @ np.array([0.02, 0.02, 0.25])
    sigma = np.hypot(noise, range_noise * inverse**2)
    inverse = inverse + sigma * random.normal(size=CAMERA.shape)
    inverse[random.random(CAMERA.shape) < outliers] += 0.05
    image = RangeImage(CAMERA.rays, inverse.astype(np.float32), CAMERA)
    blocks = block_moments(image.inverse, image.rays, weights(image), 4)
    _, residual = slopes_and_residuals(blocks, image.rays, 4)
    return residual_noise(blocks, residual, 4)


def test_variance_is_the_sum_of_both_kinds():
    sensor = STATED._replace(noise=0.003, range_noise=0.001, distortion=0.002)
    inverse = np.array([0.2, 1.0, 3.0])
    np.testing.assert_allclose(
        random_variance(sensor, inverse**2), 9e-6 + 1e-6 * inverse**4, rtol=1e-5
    )
    sensor = sensor._replace(range_distortion=0.005)
    np.testing.assert_allclose(
        systematic_variance(sensor, inverse**2), 4e-6 + 25e-6 * inverse**4, rtol=1e-5
    )


@pytest.mark.parametrize('noise', [0.0005, 0.003])
@pytest.mark.parametrize('outliers', [0.0, 0.005])
def test_white_noise_of_the_inverse_range_is_recovered(noise, outliers):
    """Within 10 %, also where 8 % of the blocks hold an outlier."""
    sensor = STATED.measured(*shown(noise, 0.0, outliers))
    for inverse in (0.25, 0.7, 1.2):
        assert np.sqrt(random_variance(sensor, inverse**2)) == pytest.approx(noise, rel=0.1)


def test_white_noise_of_the_range_is_recovered():
    sensor = STATED.measured(*shown(0.0, 0.004))
    for inverse in (0.25, 0.7, 1.2):
        assert np.sqrt(random_variance(sensor, inverse**2)) == pytest.approx(
            0.004 * inverse**2, rel=0.15
        )


def test_a_clean_image_leaves_the_stated_noise():
    stated = SensorModel.from_config(Config())
    sensor = stated.measured(*shown(1e-5, 0.0))
    inverse = np.array([0.25, 0.7, 1.2])
    np.testing.assert_allclose(
        random_variance(sensor, inverse**2), random_variance(stated, inverse**2), rtol=1e-6
    )


def test_few_blocks_say_nothing():
    inverse, residual = shown(0.01, 0.0)
    assert STATED.measured(inverse[:10], residual[:10]) == STATED
    assert STATED.measured(inverse[:0], residual[:0]) == STATED


@given(
    arrays(np.float64, 100, elements=st.floats(1e-3, 1e3)),
    arrays(np.float64, 100, elements=st.floats(0, 1e3)),
    st.floats(0, 0.1),
    st.floats(0, 0.1),
)
def test_never_below_the_stated(inverse, residual, noise, range_noise):
    stated = STATED._replace(noise=noise, range_noise=range_noise)
    sensor = stated.measured(inverse, residual)
    assert sensor.noise >= noise and sensor.range_noise >= range_noise
    assert np.isfinite(random_variance(sensor, inverse**2)).all()
    assert sensor == stated._replace(noise=sensor.noise, range_noise=sensor.range_noise)


@pytest.mark.parametrize(('white', 'width'), [(1.0, 2.0), (0.33, 2.0), (0.0, 0.7), (0.5, 0.0)])
def test_a_patch_is_what_the_mean_of_four_pixels_keeps_of_the_noise(white, width):
    sensor = STATED._replace(white=white, correlation=width)
    rows, columns = np.indices((2, 2)).reshape(2, 4)
    squared = (rows[:, None] - rows) ** 2 + (columns[:, None] - columns) ** 2
    field = np.exp(-squared / (4 * width**2)) if width else np.eye(4)
    covariance = white * np.eye(4) + (1 - white) * field
    assert sensor.patch == pytest.approx(4 * covariance.mean(), rel=1e-9)
