"""The depth sensors of simulations: statistics as of real frames, and what each of them is."""

import numpy as np
import pytest

from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.io.images import read_depth
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import Pose, Scene, kinect_room
from rangeseg_ros.simulation.sensors.catalogue import SENSORS
from rangeseg_ros.simulation.sensors.kinect import BASELINE as KINECT_BASELINE
from rangeseg_ros.simulation.sensors.kinect import NOISES, QUANTUM, Kinect
from rangeseg_ros.simulation.sensors.sensor import resize, slopes
from rangeseg_ros.simulation.sensors.stereo import BASELINE, RealSense, distortion
from rangeseg_ros.simulation.solids import box, half_space


def in_camera_frame(*solids):
    return Scene(solids, (Pose(np.eye(3), np.zeros(3)),))


def wall(z, tilt=0.0):
    angle = np.radians(tilt)
    return half_space((0, np.sin(angle), -np.cos(angle)), (0, 0, z))


def plate(z, size=0.4):
    return box((size, size, 0.01), np.eye(3), (0, 0, z + 0.005))


def metres(depth):
    return depth / 1000 if depth.dtype == np.uint16 else depth.astype(float)


def block_deviations(depth, labels, size):
    """Standard deviation of the residual of a plane in blocks on one region, in 1/z, 1/m."""

    def blocks(image):
        windows = np.lib.stride_tricks.sliding_window_view(image, (size, size))
        return windows[::size, ::size].reshape(-1, size * size)

    inverse = blocks(1 / np.where(depth > 0, depth, np.inf))
    label = blocks(labels)
    flat = (label.min(1) == label.max(1)) & (label[:, 0] > 0)
    plane = np.stack([np.ones(size * size), *np.indices((size, size)).reshape(2, -1)], axis=1)
    return np.sqrt(np.linalg.lstsq(plane, inverse[flat].T, rcond=None)[1] / (size * size - 3))


# Medians over the blocks of 4, 8, 16 and 32 pixels on the planes of real frames: Kinect (six
# frames), RealSense (three), a phone's time of flight, a tablet's lidar (the single frame times
# and over 1.5; no wider than the others scatter).
REAL = {
    'kinect': [(0.00068, 0.00096), (0.00095, 0.00114), (0.00123, 0.00139), (0.00141, 0.00156)],
    'realsense': [(0.0011, 0.0018), (0.0013, 0.0021), (0.0019, 0.0029), (0.0033, 0.005)],
    'tof': [(0.00086, 0.0019), (0.00125, 0.0028), (0.0017, 0.0038), (0.0023, 0.005)],
    'lidar': [(0.0001, 0.00021), (0.00011, 0.00024), (0.00012, 0.00027), (0.00015, 0.00035)],
}


@pytest.mark.slow
@pytest.mark.parametrize('name', REAL)
def test_residuals_by_block_size_are_like_those_of_real_frames(name):
    found = []
    for seed in (0, 1):
        frame = simulate(kinect_room(seed), SENSORS[name](seed), seed=seed)
        image = metres(frame.depth), frame.labels
        found.append([np.median(block_deviations(*image, size)) for size in (4, 8, 16, 32)])
    for value, (low, high) in zip(np.median(found, axis=0), REAL[name], strict=True):
        # The real ranges are those of few frames, on other scenes.
        assert 0.9 * low <= value <= 1.1 * high


@pytest.mark.parametrize('name', SENSORS)
def test_same_seeds_same_frame_and_truth_where_depth_is(tmp_path, name, run):
    camera = resize(SENSORS[name].camera, 160, 120)
    frame, *others = (
        simulate(kinect_room(1), SENSORS[name](sensor_seed), camera, seed=seed)
        for sensor_seed, seed in ((2, 1), (2, 3), (3, 1))
    )
    assert np.array_equal(frame.labels > 0, frame.depth > 0) and (frame.depth > 0).mean() > 0.5
    differ = [not np.array_equal(frame.depth, other.depth) for other in others]
    assert differ == [name != 'ideal', name not in ('ideal', 'lidar')]
    words = '--sensor', name, '--sensor-seed', 2, '--seed', 1, '--scenes', 1, '--width', 160
    output = tmp_path / 'rooms'
    assert run('simulate', 'rooms', *words, '--height', 120, '--output', output)[0] == 0
    rounded = read_depth(output / 'depth/000001.png')
    np.testing.assert_allclose(rounded, 1000 * metres(frame.depth), atol=0.501)


# Metres at which there is nothing to be seen, and at last something.
REACH = {'kinect': (0.79, 0.81), 'realsense': (0.166, 0.172), 'tof': (0.03, 40.0, 0.15)}
REACH |= {'lidar': (8.1, 7.9), 'ideal': (100.0,)}


@pytest.mark.parametrize('name', SENSORS)
def test_sensors_look_straight_ahead_and_see_walls_within_their_reach(name):
    camera, shares = SENSORS[name].camera, []
    assert (camera.cx, camera.cy) == ((camera.width - 1) / 2, (camera.height - 1) / 2)
    for z in (np.inf, *REACH[name]):
        depth, random = np.full(camera.shape, z), np.random.default_rng(0)
        shares.append((SENSORS[name](0).measure(depth, camera, random) > 0).mean())
    assert not any(shares[:-1]) and shares[-1] > 0.8


def test_the_distortion_of_stereo_is_a_bowl_of_either_sign():
    """As deep along rows as along columns, with half to all of 3 mm at a metre."""
    v, u = (axis.ravel() for axis in np.mgrid[-1:1:30j, -1:1:40j])
    terms = np.stack([v**2, u**2, v, u, np.ones(len(v))], axis=1)
    fields = np.stack([distortion((30, 40), seed).ravel() for seed in range(40)], axis=1)
    down, across, *slopes, _ = np.linalg.lstsq(terms, fields, rcond=None)[0]
    np.testing.assert_allclose(np.abs([down, across]).mean(axis=1), 0.75 * 0.003, rtol=0.2)
    assert ((down > 0) == (across > 0)).mean() > 0.9 and 10 < (down > 0).sum() < 30
    assert np.abs(slopes).mean() < 0.001


def test_stereo_sees_nothing_left_of_an_object_and_at_the_left_border():
    near, far = 0.5, 1.5
    frame = simulate(in_camera_frame(wall(far), plate(near)), RealSense(), seed=0)
    blind = (frame.depth == 0).mean(axis=0)
    border = 424 * BASELINE / far
    assert blind[: int(border) - 2].min() > 0.95 and blind[int(border) + 3] < 0.3
    left, right = 424 - 424 * 0.2 / near, 424 + 424 * 0.2 / near
    shadow = 424 * BASELINE * (1 / near - 1 / far)
    rows = frame.depth[160:320]
    assert (rows[:, int(left - shadow) + 3 : int(left) - 3] == 0).mean() > 0.95
    assert (rows[:, int(right) + 5 : int(right + shadow)] == 0).mean() < 0.3


@pytest.mark.parametrize(('sensor', 'limit'), [(Kinect(), 80), (RealSense(), 84)])
def test_surfaces_at_grazing_angles_are_not_seen(sensor, limit):
    for tilt in (limit - 5, limit + 5):
        depth = simulate(in_camera_frame(wall(2.0, tilt)), sensor).depth
        assert ((depth[238:242] > 0).mean() > 0.5) == (tilt < limit)


def test_slopes_of_a_depth_image():
    camera = Camera(160, 120, 146.0, 146.0, 79.5, 59.5)
    normal = np.array([0, np.sin(np.radians(50)), -np.cos(np.radians(50))])
    rays = camera.rays.astype(float)
    cosine = -(rays @ normal) / np.linalg.norm(rays, axis=-1)
    found, seen = slopes(rays @ normal / -2.0, camera), cosine > 0.1
    assert found[seen] == pytest.approx(np.tan(np.arccos(cosine[seen])), rel=1e-4)


@pytest.mark.parametrize('noise', NOISES)
def test_shadow_lies_left_of_the_occluder_and_is_as_wide_as_parallax(noise):
    near, far = 1.0, 2.0
    frame = simulate(in_camera_frame(wall(far), plate(near)), Kinect(0, noise))
    hole = np.flatnonzero(frame.depth[240, :-8] == 0)
    left = np.argmax(frame.labels[240] == frame.labels[240, 320])
    np.testing.assert_array_equal(hole, np.arange(left - len(hole), left))
    # Real sensors leave three quarters of it blank.
    width = (0.75 if noise == 'measured' else 1.0) * 585 * KINECT_BASELINE * (1 / near - 1 / far)
    # Pixels less than a half behind what is before them are one surface at a grazing angle.
    assert abs(len(hole) + 0.5 - width) <= 1 and (frame.labels[240, hole] == 0).all()


@pytest.mark.parametrize('sensor', [*(Kinect(0, noise) for noise in NOISES[:3]), RealSense()])
def test_depth_takes_only_the_values_of_quantised_disparity(sensor):
    frame = simulate(kinect_room(0), sensor, resize(sensor.camera, 320, 240), seed=1)
    # Of the data sheet and of real frames, 1/m.
    quantum = 1 / (frame.camera.fx * 0.05 * 32) if isinstance(sensor, RealSense) else 0.0029
    possible = np.rint(1000 / (quantum * np.arange(1, 126 * 32 + 1)))
    assert frame.depth.dtype == np.uint16
    assert np.isin(frame.depth[frame.depth > 0], possible).all()


@pytest.mark.parametrize('z', [1.0, 3.0])
@pytest.mark.parametrize('noise', ['independent', 'correlated'])
def test_textbook_noise(z, noise):
    # Tilted, so that every phase of the quantisation occurs.
    scene = in_camera_frame(wall(z, 20))
    true = simulate(scene, Kinect(0, 'none')).depth.astype(float)
    error = simulate(scene, Kinect(0, noise), seed=3).depth / 1000 - true
    expected = np.hypot(0.0012 + 0.0019 * (true - 0.4) ** 2, QUANTUM * true**2 / np.sqrt(12))
    # 300,000 pixels, or 20,000 independent ones when correlated.
    assert (error / expected).std() == pytest.approx(1, abs=0.03)
    assert (error / expected).mean() == pytest.approx(0, abs=0.03)


@pytest.mark.parametrize('sigma', [None, (2.0, 2.0), (3.0, 8.0)])
def test_smooth_field_has_unit_variance_up_to_the_border(sigma):
    random = np.random.default_rng(0)
    fields = np.array([smooth_field((40, 30), sigma, random) for _ in range(400)])
    assert fields.std() == pytest.approx(1, rel=0.03)
    assert [fields[:, 0].std(), fields[..., -1].std()] == pytest.approx([1, 1], rel=0.1)
    if sigma:
        # The autocorrelation of a smoothed field is the kernel convolved with itself.
        along = [(fields[..., 0] * fields[..., k]).mean() for k in range(6)]
        assert along == pytest.approx(np.exp(-((np.arange(6) / sigma[0] / 2) ** 2)), abs=0.06)
