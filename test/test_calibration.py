"""Learning the distortion of a sensor: against a known field, what cannot be, and the command."""

import cv2
import numpy as np
import pytest
import yaml
from message_classes import cloud
from rosbags.typesys import Stores
from scipy.ndimage import gaussian_filter

from rangeseg_ros import Camera, Config, RangeImage
from rangeseg_ros.batch.calibration import ResidualsOfFrame, Source
from rangeseg_ros.core.calibration.calibrate import (
    CalibrationError,
    _blocks,
    _deviation,
    _settled_weights,
    calibrate,
    without_plane,
)
from rangeseg_ros.core.calibration.field import _roughness, residuals, robust_weights, solve
from rangeseg_ros.core.calibration.sightings import cell_grid, concatenate, find_sightings
from rangeseg_ros.core.sensing.distortion import DistortionMap
from rangeseg_ros.io.bag_writer import BagWriter
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.io.distortion import read_distortion
from rangeseg_ros.io.images import write_image
from rangeseg_ros.io.recordings import message_types
from rangeseg_ros.messages.make import CLOUD
from rangeseg_ros.simulation.fields import smooth_field

CAMERA = Camera(80, 60, 73.0, 73.0, 39.5, 29.5)
NOISE = 0.0013


def true_map(scale=0.002):
    """Waves and a bowl, without their plane."""
    v, u = np.mgrid[-1:1:60j, -1:1:80j]
    field = scale * (1.5 * u * u + np.sin(4 * u + 1) * np.cos(3 * v))
    return without_plane(field, np.ones(CAMERA.shape, bool))


def frames(count, error, seed=0, noise=NOISE, rows=60, wrong=0):
    """Images of two slanted planes, labels of upper rows; each `wrong`-th takes both for one."""
    random = np.random.default_rng(seed)
    for k in range(count):
        labels = np.ones(CAMERA.shape, np.uint16)
        labels[:, random.integers(25, 55) :] = 2
        slopes, depths = random.uniform(-0.3, 0.3, (2, 2)), random.uniform(0.8, 3.0, (2, 1))
        thetas = np.column_stack([slopes, np.ones(2)]) / depths
        inverse = (CAMERA.rays * thetas[labels - 1]).sum(axis=2)
        inverse += error(inverse) if callable(error) else error
        inverse += noise * smooth_field(CAMERA.shape, (1.0, 1.0), random)
        if wrong and k % wrong == 0:
            labels[:] = 1
        labels[rows:] = 0
        yield labels, RangeImage.from_depth((1 / inverse).astype(np.float32), CAMERA)


def rms(image):
    return float(np.sqrt((image**2).mean()))


def seen(count, error, **options):
    return concatenate([find_sightings(*frame) for frame in frames(count, error, **options)])


def left_of(cells, values, weight):
    """What the planes leave of values, by weighted least squares."""
    left = values.copy()
    for k in range(len(cells.frame)):
        own = cells.plane() == k
        root, ray = np.sqrt(weight[own]), cells.ray[own]
        left[own] -= ray @ np.linalg.lstsq(root[:, None] * ray, root * values[own])[0]
    return left


@pytest.mark.parametrize(('count', 'wrong', 'share'), [(15, 0, 0.4), (40, 0, 0.3), (40, 4, 0.3)])
def test_known_field_is_recovered(count, wrong, share):
    result = calibrate(seen(count, true_map(), wrong=wrong), CAMERA.shape, CAMERA)
    off = rms(result.distortion.offset - true_map())
    assert off < share * rms(true_map())
    # As uncertain as it says, within what five blocks tell.
    assert 0.3 < off / rms(result.distortion.deviation) < 3
    assert wrong or result.after < 0.85 * result.before


def test_second_coefficient_where_the_range_is_offset():
    offset, known = true_map(0.01), np.indices(CAMERA.shape)[0] < 46
    cells = seen(40, lambda inverse: inverse**2 * offset, rows=46)
    distortion = calibrate(cells, CAMERA.shape).distortion
    moments = [distortion.offset * part for part in (1, *np.indices(CAMERA.shape))]
    # Of what was not seen nothing is told; the rest has no plane in it.
    assert distortion.offset[:44].any() and not distortion.offset[46:].any()
    assert abs(distortion.slope.mean()) < 1e-6 and abs(np.mean(moments, axis=(1, 2))).max() < 1e-6
    for inverse in (0.45, 0.6, 0.9):
        error = distortion.offset + distortion.slope * (inverse - distortion.reference)
        truth = inverse**2 * offset
        # A slope that is the same everywhere scales all planes and stays free.
        assert rms(without_plane(error - truth, known)[:46]) < 0.5 * rms(truth[:46])


def test_weights_settle_to_those_of_the_field_of_the_frames_that_count():
    cells, grid = seen(20, true_map()), cell_grid(CAMERA.shape)
    assert cells.frames == 20
    first = cells.frame[cells.plane()] < 4
    other = cells._replace(inverse=np.where(first, 2 * cells.inverse**2, cells.inverse))
    one, two = (_blocks(each, grid) for each in (cells, other))
    assert np.array_equal(one[0][1], two[0][1]) and not np.array_equal(one[1][1], two[1][1])
    truth = true_map().reshape(30, 2, 40, 2).mean(axis=(1, 3)).ravel()[cells.cell]
    known, none = (robust_weights(cells, field) for field in (truth, 0.0))
    assert rms(_settled_weights(cells, grid) - known) < 0.5 * rms(none - known)


@pytest.mark.parametrize('seed', [0, 1])
def test_sensor_without_distortion_gets_a_field_of_its_uncertainty(seed):
    distortion = calibrate(seen(30, 0.0, seed=seed), CAMERA.shape).distortion
    # Within what five blocks tell.
    assert rms(distortion.offset) < 3 * rms(distortion.deviation)
    assert rms(distortion.offset) < 0.1 * NOISE


def test_the_joint_solution_is_the_one_of_least_squares():
    """Of what planes and fields leave and of the fields' differences: their derivative is 0."""
    cells, draw = seen(6, true_map(), noise=0.0), np.random.default_rng(0)
    weight = draw.uniform(0.5, 1, len(cells.cell))
    grid, smoothness = cell_grid(CAMERA.shape), (64.0, 8.0)
    basis = np.stack([np.ones(len(weight)), draw.normal(size=len(weight))])

    def derivative(field):
        left = left_of(cells, cells.inverse - (basis * field[:, cells.cell]).sum(axis=0), weight)
        pull = [np.bincount(cells.cell, weight * part * left) for part in basis]
        bent = [_roughness(grid, k) @ part for k, part in enumerate(field)]
        return pull - np.multiply(bent, np.reshape(smoothness, (2, 1)))

    found = solve(cells, basis, weight, grid, smoothness)
    # As closely as it is solved for.
    assert rms(derivative(found)) < 1.01e-3 * rms(derivative(0 * found))


def test_weights_follow_what_planes_leave():
    """As robust deviations of planes and residuals have it, with 5 of 6 planes alike."""
    cells, draw = seen(3, true_map()), np.random.default_rng(0)
    inverse = cells.inverse + draw.normal(0, np.where(cells.plane() == 1, 0.05, 0.0005))
    cells = cells._replace(inverse=inverse)
    error = draw.normal(0, 0.001, len(inverse))
    left = left_of(cells, inverse - error, np.ones(len(inverse)))
    np.testing.assert_allclose(residuals(cells, inverse - error), left, atol=1e-8)
    size = [max(np.median(abs(left[cells.plane() == k])), np.median(abs(left))) for k in range(6)]
    spread = 1.4826 * np.array(size)[cells.plane()]
    expected = (1.4826 * np.median(abs(left)) / spread) ** 2 / (1 + (left / spread / 2.385) ** 2)
    np.testing.assert_allclose(robust_weights(cells, error), expected, rtol=1e-5)


def test_deviations_are_those_of_a_jackknife_and_the_bias():
    draw, known = np.random.default_rng(1), np.ones((12, 16), bool)
    known[:, 13:] = False
    fields, bias = draw.normal(size=(5, 12, 16)), 0.3 * draw.normal(size=(12, 16))
    left = np.stack([without_plane(field, known) for field in (*fields, bias)])
    squares = 4 * left[:5].var(axis=0) + left[5] ** 2
    # Means over the cells around, of those that are known.
    sums, weights = (gaussian_filter(part * known, 5, mode='mirror') for part in (squares, 1.0))
    expected = sums / weights * known
    np.testing.assert_allclose(_deviation(fields, bias, known) ** 2, expected, rtol=1e-9)


def test_sightings_are_means_of_cells_inside_a_plane():
    """Cells of 2 x 2 pixels, two from any other region, without what is five deviations off."""
    draw, camera = np.random.default_rng(6), Camera(80, 60, 73.0, 70.0, 39.0, 30.0)
    labels = np.ones(camera.shape, np.uint16)
    labels[:, 41:], labels[20:23, :9] = 2, 0
    inverse = camera.rays @ np.array([0.1, -0.1, 0.5]) + draw.normal(0, 1e-3, camera.shape)
    inverse[draw.random(camera.shape) < 0.2] = 0
    inverse[30, 10:20] *= 1.03
    image = RangeImage(camera.rays, inverse.astype(np.float32), camera)
    cells = find_sightings(labels, image)
    expected = []
    for label in (1, 2):
        rim = cv2.dilate((labels != label).astype(np.uint8), np.ones((5, 5), np.uint8))
        own = (rim == 0) & image.valid & ~(image.inverse > camera.rays @ [0.1, -0.1, 0.5] + 0.007)
        for number, (i, j) in enumerate(np.ndindex(30, 40)):
            part = np.s_[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
            if np.count_nonzero(own[part]) >= 2:
                ray = camera.rays[part][own[part]].mean(axis=0)
                expected.append([number, image.inverse[part][own[part]].mean(), *ray])
    found = np.column_stack([cells.cell, cells.inverse, cells.ray])
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)
    assert (cells.frame.tolist(), cells.frames, len(cells.start)) == ([0, 0], 1, 3)


def test_roughness_is_of_second_differences_and_of_first_ones_of_a_slope():
    for grid in ((1, 1), (1, 8), (2, 3), (6, 9)):
        field = np.random.default_rng(0).normal(size=grid)
        down, right = (np.diff(field, axis=axis) for axis in (0, 1))
        twist = np.diff(down, axis=1)
        second = np.diff(down, axis=0), np.diff(right, axis=1), twist, twist
        for place, differences in enumerate((second, (down, right))):
            found = field.ravel() @ _roughness(grid, place) @ field.ravel()
            assert found == pytest.approx(sum((part**2).sum() for part in differences), abs=1e-9)


@pytest.mark.parametrize(
    ('count', 'rows', 'words'),
    [(6, 60, 'too few planes'), (20, 60, 'too few ranges'), (20, 20, 'too few positions')],
)
def test_recordings_that_do_not_hold_it_are_refused_with_advice(count, rows, words):
    cells = seen(count, true_map(), rows=rows)
    if words == 'too few ranges':
        # Head-on, so that slant does not make distances.
        cells = cells._replace(inverse=np.full_like(cells.inverse, 0.5))
    with pytest.raises(CalibrationError, match=f'{words}.*record walls'):
        calibrate(cells, CAMERA.shape)


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Depth images of a distorted sensor, with gaps in their numbers, and a bag of its clouds."""
    path = tmp_path_factory.mktemp('recording')
    (path / 'depth').mkdir()
    write_camera(path / 'camera.yaml', CAMERA)
    store = message_types(Stores.ROS2_JAZZY)
    with BagWriter(path / 'bag') as bag:
        topic = bag.add_connection('/points', CLOUD, typestore=store)
        for number, (_, image) in enumerate(frames(22, true_map(0.004), noise=0.0006)):
            depth = np.rint(1000 / image.inverse).astype(np.uint16)
            write_image(path / 'depth' / f'frame-{3 * number:06d}.depth.png', depth)
            points = RangeImage.from_depth(depth, CAMERA).points
            bag.write(topic, number, store.serialize_cdr(cloud(points), CLOUD))
    return path


def test_the_true_map_takes_the_residuals_away(folder):
    """What planes leave of a frame before and after it, in the places that either has."""
    distortion = DistortionMap(true_map(0.004).astype(np.float32), camera=CAMERA)
    source = Source(folder / 'depth', CAMERA)
    images, planes = ResidualsOfFrame(source, Config(), 5, distortion).run()
    assert planes[1] == 2 and images.shape == (2, *CAMERA.shape)
    before, after = (np.sqrt(np.nanmean(image**2)) for image in images)
    assert np.isfinite(images[1]).mean() > 0.8 and 0.0003 < after < 0.0012 < before


@pytest.mark.slow
def test_command_writes_map_parameters_and_report(folder, tmp_path, run):
    output, params = tmp_path / 'map.tiff', tmp_path / 'sensor.yaml'
    camera = ['--camera', folder / 'camera.yaml', '--jobs', 1]
    files = '--output', output, '--params', params
    (folder / 'x_report.html').write_text('mine')
    assert 'exists' in run('calibrate', folder / 'depth', *camera, '--output', folder / 'x')[2]
    code, said, error = run('calibrate', folder / 'depth', *camera, *files)
    assert code == 0 and 'less' in said, error
    distortion = read_distortion(output)
    assert distortion.camera == CAMERA
    assert rms(distortion.offset - true_map(0.004)) < 0.4 * rms(true_map(0.004))
    assert Config(**yaml.safe_load(params.read_text())).distortion_map == str(output)
    page = (tmp_path / 'map_report.html').read_text()
    assert 'before' in page and page.count('data:image/svg') >= 3
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {'map.tiff', 'map_report.html', 'sensor.yaml'}

    # The same from a bag that was cut off, in place of the map before. Points tell the camera.
    (folder / 'bag' / 'metadata.yaml').unlink()
    code, _, error = run('calibrate', folder / 'bag', '--output', output, '--jobs', 1)
    assert code == 0, error
    again = read_distortion(output)
    assert again.offset == pytest.approx(distortion.offset, abs=1e-6)
    np.testing.assert_allclose(again.camera.matrix, CAMERA.matrix, atol=2e-3)


@pytest.mark.slow
def test_interrupted_run_goes_on_where_it_was(folder, tmp_path, monkeypatch, run):
    output = tmp_path / 'map.tiff'
    arguments = [folder / 'depth', '--camera', folder / 'camera.yaml', '--output', output]
    segmented = []
    real = find_sightings

    def counting(labels, image):
        segmented.append(1)
        if len(segmented) == 15:
            raise KeyboardInterrupt
        return real(labels, image)

    monkeypatch.setattr('rangeseg_ros.batch.calibration.find_sightings', counting)
    assert run('calibrate', *arguments, '--jobs', 1)[0] == 130 and not output.exists()
    code, _, error = run('calibrate', *arguments, '--jobs', 1)
    assert code == 0, error
    # Of the first part of ten frames nothing is done again.
    assert len(segmented) == 15 + 12 and not list(tmp_path.glob('.*'))


def test_bad_input_ends_in_one_line_and_writes_nothing(folder, tmp_path, refused):
    other, empty, few = (tmp_path / name for name in ('other', 'empty', 'few'))
    other.write_text('noise: 0.1')
    empty.mkdir()
    write_image(few / 'a.png', np.full(CAMERA.shape, 1000, np.uint16))
    camera, output = ('--camera', folder / 'camera.yaml'), ('--output', tmp_path / 'map.tiff')
    for words, recording, *options in (
        ('needs --camera', folder / 'depth', *output),
        ('neither a bag nor a folder of depth images', empty, *camera, *output),
        ('exists already, and is no distortion map', folder / 'depth', *camera, '--output', other),
        ('exists already, not overwritten', folder / 'depth', *camera, *output, '--params', other),
        ('too few planes', few, *camera, *output),
    ):
        assert words in refused('calibrate', recording, *options, '--jobs', 1)
    assert other.read_text() == 'noise: 0.1' and set(tmp_path.glob('[!.]*')) == {other, empty, few}
