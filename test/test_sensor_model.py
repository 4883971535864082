"""The sensor model measured in simulated images whose errors are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter, minimum_filter

from rangeseg_ros import Camera, Config, RangeImage, Segmenter
from rangeseg_ros.core.fitting.error_law import Law, Strata, fit_law
from rangeseg_ros.core.fitting.noise import ROUGH, _split, measured_sensor, nested, quantisation
from rangeseg_ros.core.fitting.steps import jump_steps
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.moments import COUNT, SIZE
from rangeseg_ros.core.sensing.sensor import (
    SensorModel,
    correlated_residuals,
    random_variance,
    systematic_variance,
)
from rangeseg_ros.simulation.fields import smooth_field

CAMERA = Camera(640, 480, 580.0, 580.0, 319.5, 239.5)
STATED = SensorModel.from_config(Config())


def three_planes():
    """Inverse range of planes 0.5 to 5 m away."""
    inverse = CAMERA.rays @ np.array([0.1, 0.05, 1.2])
    inverse[160:] = CAMERA.rays[160:] @ np.array([0.05, -0.1, 0.7])
    inverse[320:] = CAMERA.rays[320:] @ np.array([0.02, 0.02, 0.25])
    return inverse


def sensor_of(inverse):
    image = RangeImage(CAMERA.rays, inverse.astype(np.float32), CAMERA)
    return measured_sensor(nested(image), STATED, quantisation(image.inverse))


def test_variance_is_the_sum_of_both_kinds():
    known = {'noise': 0.003, 'range_noise': 0.001, 'distortion': 0.002, 'range_distortion': 0.005}
    sensor, squared = STATED._replace(**known), np.array([0.2, 1.0, 3.0]) ** 2
    random, systematic = 9e-6 + 1e-6 * squared**2, 4e-6 + 25e-6 * squared**2
    np.testing.assert_allclose(random_variance(sensor, squared), random, rtol=1e-5)
    np.testing.assert_allclose(systematic_variance(sensor, squared), systematic, rtol=1e-5)


@pytest.mark.parametrize('noise', [0.0002, 0.003])
@pytest.mark.parametrize('holes', [0.0, 0.3])
def test_white_noise_is_measured_up_and_down(noise, holes):
    """Far below what is known beforehand as well as above it, and with holes."""
    random = np.random.default_rng(1)
    inverse = three_planes() + random.normal(0, noise, CAMERA.shape)
    inverse[random.random(CAMERA.shape) < holes] = 0
    sensor = sensor_of(inverse)
    assert sensor.noise == pytest.approx(noise, rel=0.15) and sensor.range_noise == 0
    assert sensor.white > 0.7 and sensor.distortion < 0.6 * noise


def test_quantisation_shows_beside_steps_of_several_quanta():
    random = np.random.default_rng(7)
    steps = random.choice([1, 2, 3, 4], (100, 200)) * random.choice([-1, 0, 1], (100, 200))
    rows = np.arange(500, 2000, 15)[:, None]
    found = quantisation((1e-3 * (rows + np.cumsum(steps, axis=1))).astype(np.float32))
    assert found == (pytest.approx(1e-3, rel=1e-3), 0)
    # What is larger is a jump.
    bars = 0.4 + 0.1 * (np.indices(CAMERA.shape)[1] // 16 % 2)
    assert quantisation(bars.astype(np.float32)) == (0, 0)


@pytest.mark.parametrize('step', [0.005, 0.01, 0.02])
def test_errors_of_what_is_only_rounded_are_those_of_rounding(step):
    sensor = sensor_of(1 / (step * np.rint(1 / three_planes() / step)))
    assert sensor.range_quantum == pytest.approx(step, rel=1e-3) and sensor.quantum == 0
    errors = sensor.range_noise, sensor.range_distortion
    assert errors == pytest.approx((step / 12**0.5,) * 2, rel=0.01)
    random = np.random.default_rng(6)
    inverse = three_planes() + step / 5 * smooth_field(CAMERA.shape, (2.0, 2.0), random)
    sensor = sensor_of(step * np.rint(inverse / step))
    assert sensor.quantum == pytest.approx(step, rel=0.01) and sensor.range_quantum == 0


def test_the_standard_error_of_the_noise_is_what_it_scatters_by():
    found = []
    for seed in range(12):
        inverse = three_planes() + np.random.default_rng(seed).normal(0, 0.003, CAMERA.shape)
        sensor = sensor_of(inverse)
        found.append((sensor.noise / 0.003, sensor.noise_error))
    (mean, told), (scatter, _) = np.mean(found, axis=0), np.std(found, axis=0)
    assert scatter / 2 < told < 3 * scatter and abs(mean - 1) < 2 * told


def test_noise_of_the_range_is_told_from_that_of_its_inverse():
    random = np.random.default_rng(2)
    inverse, smooth = three_planes(), smooth_field(CAMERA.shape, (2.0, 2.0), random)
    for noise, error in ((random.normal(size=CAMERA.shape), 0.15), (smooth, 0.25)):
        sensor = sensor_of(inverse + 0.004 * inverse**2 * noise)
        assert sensor.range_noise == pytest.approx(0.004, rel=error) and sensor.noise <= 1e-4


@pytest.mark.parametrize('error', [0.6, 0.0])
def test_errors_of_direction_are_told_from_others(error):
    """Of 48 planes that slope one way or the other."""
    random = np.random.default_rng(7)
    inverse = random.normal(0, 0.0005, CAMERA.shape)
    for i, j in np.ndindex(6, 8):
        slopes = random.permutation([random.choice([-0.003, -0.001, 0.001, 0.003]), 0])
        # Linear over the pixels, as planes are over a camera's rays.
        v, u = np.mgrid[-40:40, -40:40] + error * random.normal(size=(2, 80, 80))
        part = np.s_[80 * i : 80 * i + 80, 80 * j : 80 * j + 80]
        inverse[part] += random.uniform(0.4, 0.8) + slopes[0] * u + slopes[1] * v
    # Blocks that are compared slope alike to a third or so.
    assert sensor_of(inverse).direction_noise == pytest.approx(error, rel=0.3)


@pytest.mark.parametrize('like', [Law(1.0, 0.0), Law(0.0, 1.0)])
@pytest.mark.parametrize(('count', 'told'), [(13, False), (200, False), (1000, True)])
def test_a_few_blocks_tell_no_kind_of_error(count, told, like):
    """Of one stratum of blocks either kind explains the median, so that rounding would decide."""
    draw = np.random.default_rng(5)
    for _ in range(100):
        squared, none = draw.uniform(0.04, 4, (1, count)), np.zeros((1, count))
        strata = Strata.of(Blocks(none, squared, none, none), np.arange(count))
        shown = strata.medians(1e-6 * squared**2 * draw.uniform(0.5, 2, count))
        law = fit_law(strata, shown, np.zeros(len(shown)), like)
        in_range = told or like.quartic > 0
        assert (law.quartic > 0) == in_range and (law.constant > 0) != in_range
        if not told:
            np.testing.assert_allclose(law.facing(strata.squared)[0], shown[0], rtol=1e-5)


@pytest.mark.parametrize('far', [0.25, 0.6])
@pytest.mark.parametrize('waves', [0.004, 0.008])
def test_waves_of_the_range_are_distortion_however_far_a_surface_is(waves, far):
    """Ten times as much of the inverse range near by, and hardly any noise."""
    rows, columns = np.mgrid[0 : 1 : 1 / 480, 0 : 1 : 1 / 640]
    inverse = far + np.maximum(rows - 0.5, 0) + 2 * np.maximum(0.15 - columns, 0)
    random = np.random.default_rng(0)
    field = smooth_field(CAMERA.shape, (16.0, 16.0), random)
    noise = 6e-4 * random.standard_normal(CAMERA.shape)
    image = RangeImage.from_depth((1 / inverse + waves * field + noise).astype(np.float32), CAMERA)
    result = Segmenter().segment(image)
    assert 0.7 * waves < result.sensor.range_distortion < 2 * waves and len(result.planes) == 4


def test_strata_are_ranges_of_equal_size_and_slopes_in_them():
    squared, slope = np.random.default_rng(6).integers(0, 50, (2, 30, 40)).astype(float)
    strata = Strata.of(Blocks(slope, squared, slope, slope), np.arange(3, 1200))
    assert strata.blocks.shape == (24, 49) and len(np.unique(strata.blocks)) == strata.blocks.size
    ranges, slopes = (key.ravel()[strata.blocks] for key in (squared, slope))
    for parts in (ranges.reshape(1, 8, -1), slopes.reshape(8, 3, -1)):
        assert (parts[:, :-1].max(axis=2) <= parts[:, 1:].min(axis=2)).all()
    np.testing.assert_array_equal(strata.medians(slope), np.median(slopes, axis=1))


@pytest.mark.parametrize('seed', range(3, 13))
def test_clutter_and_outliers_change_little(seed):
    random = np.random.default_rng(seed)
    inverse = three_planes() + random.normal(0, 0.002, CAMERA.shape)
    inverse[random.random(CAMERA.shape) < 0.005] += 0.05
    inverse[100:240, 200:420] += random.normal(0, 0.05, (140, 220))
    assert sensor_of(inverse).noise == pytest.approx(0.002, rel=0.15)


@pytest.mark.parametrize('bend', [0.002, 0.006])
def test_the_stronger_planes_bend_the_more_distortion_is_measured(bend):
    """Not its overall size, but what it moves parts of planes by, to within half."""
    random = np.random.default_rng(5)
    field = bend * smooth_field(CAMERA.shape, (12.0, 12.0), random)
    sensor = sensor_of(three_planes() + random.normal(0, 0.0005, CAMERA.shape) + field)
    assert 0.5 * bend < sensor.distortion < 1.5 * bend


@pytest.mark.parametrize(('bend', 'width', 'unbent'), [(0.5, 16, 1 / 16), (0.7, 8, 1)])
def test_what_bends_by_more_than_the_prior_allows_is_more_than_one_surface(bend, width, unbent):
    """Bowls: over a width w, squares of pixels differ from a plane by w^2 / 5, as planes do."""
    row = np.tile(np.arange(-32, 32) ** 2, 10)
    noise = np.random.default_rng(0).normal(0, 1e-4, CAMERA.shape)
    inverse = 0.5 + 3e-4 * bend * (row + row[:480, None]) + noise
    image = RangeImage(CAMERA.rays, inverse.astype(np.float32), CAMERA)
    sensor = measured_sensor(nested(image), STATED._replace(distortion=3e-4), (0, 0))
    found = np.hypot(sensor.distortion, sensor.range_distortion)
    assert found == pytest.approx(3e-4 * bend * width**2 / 5, rel=0.1)
    assert sensor.unbent == pytest.approx(unbent, rel=0.1)


@pytest.mark.parametrize('seed', range(3))
def test_what_noise_hides_is_not_made_more_of(seed):
    """Creases that blocks show by less than the noise: no field is told that would show more."""
    rows, columns = (0.004 * np.abs(np.arange(n) / 60 % 2 - 1) for n in CAMERA.shape)
    creases = columns + rows[:, None]
    depth = 2 + np.arange(480)[:, None] / 960 + creases
    sensor = sensor_of(1 / (depth + np.random.default_rng(seed).normal(0, 0.02, CAMERA.shape)))
    assert sensor.range_noise == pytest.approx(0.02, rel=0.05)
    assert sensor.distortion < 1.5 * (creases / depth**2).std()


def test_an_image_that_says_too_little_leaves_what_is_known():
    inverse = np.zeros(CAMERA.shape)
    assert sensor_of(inverse) == STATED
    inverse[100:110, 100:110] = 0.5
    assert sensor_of(inverse) == STATED


@settings(max_examples=30)
@given(st.integers(0, 1000), st.floats(0, 1), st.sampled_from([1e-6, 1.0, 1e5]))
def test_whatever_the_image_the_model_is_finite(seed, holes, scale):
    random = np.random.default_rng(seed)
    inverse = scale * random.random((60, 80))
    inverse[random.random(inverse.shape) < holes] = 0
    camera = Camera(80, 60, 70.0, 70.0, 39.5, 29.5)
    scales = nested(RangeImage(camera.rays, inverse.astype(np.float32), camera))
    sensor = measured_sensor(scales, STATED, (0.0, 0.0))
    assert np.isfinite(sensor).all() and min(sensor) >= 0 and sensor.white <= 1
    steps = jump_steps(scales[0], sensor)
    assert np.isfinite(steps).all()
    assert ((steps.windows > 0) & (steps.windows <= steps.pixels)).all()


def test_steps_are_those_of_the_flat_blocks_around():
    draw, shape = np.random.default_rng(9), (9, 11)
    sensor = STATED._replace(noise=0.001, quantum=0.003, range_quantum=0.004, direction_noise=0.4)
    slope = draw.exponential(1e-5, shape)
    squared, moments = draw.uniform(0.1, 2, shape), np.zeros((*shape, SIZE))
    moments[..., COUNT] = draw.choice([3, 4, 16], shape)
    freedom = moments[..., COUNT] - 3
    tilt = 0.16 * slope
    residual = draw.choice([0.99, 1.01, 9], shape) * ROUGH * (1e-6 + tilt) * freedom
    steps = jump_steps(Blocks(moments, squared, slope, residual), sensor)
    flat = (freedom > 0) & (residual < ROUGH * (1e-6 + tilt) * freedom)
    around = minimum_filter(np.where(flat, slope, 9), 3), maximum_filter(flat * slope, 3)
    # 0 where none around is flat.
    least, most = (np.where(flat, slope, np.where(found < 9, found, 0)) for found in around)
    known = [5 * np.sqrt(0.72 * sensor.block_inflation * (1e-6 + 0.16 * t)) for t in (least, most)]
    known = np.maximum(known, 2.2 * np.maximum(0.003, 0.004 * squared))
    np.testing.assert_allclose(steps, [*known, np.sqrt(least)], rtol=1e-5)
    assert 20 < flat.sum() < 60 and (maximum_filter(flat, 3) == 0).any()


@pytest.mark.parametrize('width', [0.7, 2.0, 4.0])
def test_what_blocks_leave_of_correlated_noise(width):
    """Against fits to simulated fields."""
    field, left = smooth_field((256, 256), (width, width), np.random.default_rng(8)), {}
    for side in (4, 8, 16):
        parts = field.reshape(256 // side, side, -1, side).transpose(1, 3, 0, 2)
        terms = np.vstack([np.ones(side**2), *np.indices((side, side)).reshape(2, -1)]).T
        left[side] = np.linalg.lstsq(terms, parts.reshape(side**2, -1))[1].mean()
    expected = left[4] / 13, left[8] / 61, left[16] / 253, (left[8] - 4 * left[4]) / 9
    np.testing.assert_allclose(correlated_residuals(width), expected, rtol=0.15, atol=0.01)


@pytest.mark.parametrize('filled', [1.0, 0.6])
@pytest.mark.parametrize(('white', 'width'), [(0.3, 1.4), (1.0, 1.0), (0.0, 2.8)])
def test_white_and_correlated_noise_are_told_from_blocks_of_several_sizes(white, width, filled):
    """Of holes, planes of four blocks miss so much of the field as its residuals have."""
    small, larger, largest, apart = correlated_residuals(width)
    apart = filled * apart + (1 - filled) * small
    shown = [3 * (white + (1 - white) * v) for v in (small, larger, largest, apart)]
    total, share, length = _split(shown[:3], shown[3], filled)
    assert (total, share) == pytest.approx((3, white), abs=1e-6)
    assert white == 1 or length == width


@pytest.mark.parametrize(('white', 'width'), [(1.0, 2.0), (0.33, 2.0), (0.0, 0.7), (0.5, 0.0)])
def test_a_patch_is_what_the_mean_of_four_pixels_keeps_of_the_noise(white, width):
    sensor = STATED._replace(white=white, correlation=width)
    places = np.argwhere(np.ones((2, 2)))
    squared = ((places[:, None] - places) ** 2).sum(axis=2)
    field = np.exp(-squared / (4 * width**2)) if width else np.eye(4)
    covariance = white * np.eye(4) + (1 - white) * field
    assert sensor.pixel_inflation == pytest.approx(4 * covariance.mean(), rel=1e-9)
    # And a large region: the sum of all correlations with a pixel.
    alike = np.exp(-(np.arange(-40, 41) ** 2) / (4 * width**2)).sum() ** 2 if width else 1
    assert sensor.region_inflation == pytest.approx(white + (1 - white) * alike, rel=1e-6)


def test_what_is_said_of_the_errors():
    stereo = SensorModel(0.0034, 0.0, 0.1, 9 / (2 * np.sqrt(np.pi)), 0.005, 0.0, 35.0)
    assert str(stereo) == 'noise 0.0034 1/m, correlated over 9 px, distortion 0.005 1/m'
    assert str(stereo._replace(noise=0.0, quantum=0.1)) == 'distortion 0.005 1/m, steps of 0.1 1/m'
    laser = SensorModel(0.0, 0.012, 1.0, 0.0, 0.0, 0.0, 35.0, range_quantum=0.001)
    assert str(laser) == 'range noise 0.012 m, steps of 0.001 m'


def test_what_every_second_pixel_does_not_tell_all_pixels_do():
    """Strips of eight pixels beside such as were not measured: no block of 16 is whole."""
    field = smooth_field(CAMERA.shape, (2.0, 2.0), np.random.default_rng(10))
    sensor = sensor_of(np.where(np.arange(640) // 8 % 2 == 0, three_planes() + 0.02 * field, 0))
    assert sensor.correlation >= 1 and sensor.noise == pytest.approx(0.02, rel=0.4)
