"""Learning the distortion of a sensor: against a known field, and what cannot be learned."""

import numpy as np
import pytest
from calibration_frames import CAMERA, NOISE, frames, rms, true_map

from rangeseg_ros import RangeImage
from rangeseg_ros.core.calibration.calibrate import (
    CalibrationError,
    _blocks,
    calibrate,
    without_plane,
)
from rangeseg_ros.core.calibration.field import _roughness, solve
from rangeseg_ros.core.calibration.sightings import cell_grid, concatenate, find_sightings
from rangeseg_ros.simulation.fields import smooth_field


def seen(count, error, **options):
    return concatenate([find_sightings(*frame) for frame in frames(count, error, **options)])


@pytest.mark.parametrize('count', [15, 40])
def test_known_field_is_recovered(count):
    result = calibrate(seen(count, true_map()), CAMERA.shape, CAMERA)
    off = rms(result.distortion.offset - true_map())
    assert off < {15: 0.4, 40: 0.3}[count] * rms(true_map())
    # As uncertain as it says, within what five blocks tell.
    assert 0.3 < off / rms(result.distortion.deviation) < 3
    assert result.after < 0.85 * result.before


def test_gauge_is_the_plane_over_what_was_seen():
    def bottom_unseen(frame):
        labels, image = frame
        labels[45:] = 0
        return labels, image

    cells = concatenate([find_sightings(*bottom_unseen(f)) for f in frames(20, true_map())])
    offset = calibrate(cells, CAMERA.shape).distortion.offset.astype(float)
    known = np.zeros(CAMERA.shape, bool)
    known[:45] = True
    assert not offset[46:].any()
    v, u = np.nonzero(offset != 0)
    terms = np.stack([u, v, np.ones(len(u))], axis=1)
    plane, *_ = np.linalg.lstsq(terms, offset[v, u], rcond=None)
    assert np.abs(terms @ plane).max() < 1e-6


def test_second_coefficient_where_the_range_is_offset():
    offset = true_map(0.01)

    def range_offset(inverse):
        return inverse**2 * offset

    result = calibrate(seen(40, range_offset), CAMERA.shape)
    distortion = result.distortion
    assert distortion.slope is not None
    assert rms(distortion.slope.mean()) < 1e-6
    v, u = np.indices(CAMERA.shape)
    terms = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)
    plane = np.linalg.lstsq(terms, distortion.offset.ravel().astype(float), rcond=None)[0]
    assert np.abs(terms @ plane).max() < 1e-6
    for inverse in (0.45, 0.6, 0.9):
        error = distortion.offset + distortion.slope * (inverse - distortion.reference)
        truth = inverse**2 * offset
        known = np.ones(CAMERA.shape, bool)
        off = without_plane(error - truth, known)
        # A slope that is the same everywhere scales all planes and stays free.
        assert rms(off) < 0.5 * rms(truth)


def test_slope_that_is_no_error_of_the_range_is_learned():
    slope = 0.006 * smooth_field(CAMERA.shape, (20.0, 20.0), np.random.default_rng(3))
    cells = seen(40, lambda inverse: true_map(0.001) + slope * (inverse - 0.6))
    result = calibrate(cells, CAMERA.shape)
    assert result.distortion.slope is not None
    learned, true = result.distortion.slope.ravel(), slope.ravel() - slope.mean()
    assert np.corrcoef(learned, true)[0, 1] > 0.6
    # Smoothing takes the rest.
    assert 0.25 < learned @ true / (true @ true) < 1.1


def test_frames_left_out_do_not_weigh_the_others():
    cells = seen(12, true_map())
    first = cells.frame[cells.plane()] < 3
    other = cells._replace(inverse=np.where(first, 2 * cells.inverse**2, cells.inverse))
    one, two = (_blocks(each, cell_grid(CAMERA.shape)) for each in (cells, other))
    assert np.array_equal(one[0][1], two[0][1])
    assert not np.array_equal(one[1][1], two[1][1])


def test_near_planes_that_are_much_noisier_do_not_outvote_the_others():
    def some_near(number, frame):
        labels, image = frame
        if number % 6:
            return labels, image
        random = np.random.default_rng(number)
        noise = 0.2 * smooth_field(CAMERA.shape, (3.0, 3.0), random)
        return labels, RangeImage.from_depth(
            (1 / (5 + noise + 0 * image.inverse)).astype(np.float32), CAMERA
        )

    cells = [find_sightings(*some_near(*pair)) for pair in enumerate(frames(40, true_map()))]
    result = calibrate(concatenate(cells), CAMERA.shape)
    assert rms(result.distortion.offset - true_map()) < 0.4 * rms(true_map())
    assert result.after < 0.85 * result.before


def test_wrong_regions_do_not_bend_the_field():
    cells = []
    for number, (labels, image) in enumerate(frames(40, true_map())):
        # Two planes taken as one in every fourth frame.
        wrong = np.ones_like(labels) if number % 4 == 0 else labels
        cells.append(find_sightings(wrong, image))
    offset = calibrate(concatenate(cells), CAMERA.shape).distortion.offset
    assert rms(offset - true_map()) < 0.3 * rms(true_map())


@pytest.mark.parametrize('seed', [0, 1])
def test_sensor_without_distortion_gets_a_field_of_its_uncertainty(seed):
    distortion = calibrate(seen(30, 0.0, seed=seed), CAMERA.shape).distortion
    # Within what five blocks tell.
    assert rms(distortion.offset) < 3 * rms(distortion.deviation)
    assert rms(distortion.offset) < 0.1 * NOISE


def test_joint_solution_is_that_of_dense_least_squares():
    cells = seen(6, true_map(), noise=0.0)
    grid = cell_grid(CAMERA.shape)
    size, weight = grid[0] * grid[1], np.random.default_rng(0).uniform(0.5, 1, len(cells.cell))
    found = solve(cells, np.ones((1, len(weight))), weight, grid, [1.0])[0]
    planes = len(cells.frame)
    design = np.zeros((len(weight), size + 3 * planes))
    rows = np.arange(len(weight))
    design[rows, cells.cell] = 1
    for axis in range(3):
        design[rows, size + 3 * cells.plane() + axis] = cells.ray[:, axis]
    v, u = (np.eye(n)[1:] - np.eye(n)[:-1] for n in grid)
    vv, uu = (np.diff(np.eye(n), 2, axis=0) for n in grid)
    smooth = np.vstack(
        [
            np.kron(np.eye(grid[0]), uu),
            np.kron(vv, np.eye(grid[1])),
            np.sqrt(2) * np.kron(v, u),
        ]
    )
    smooth = np.hstack([smooth, np.zeros((len(smooth), 3 * planes))])
    root = np.sqrt(weight)[:, None]
    # By the normal equations, of which a plane under all of the field is free.
    design = root * design
    square, right = design.T @ design + smooth.T @ smooth, design.T @ (root[:, 0] * cells.inverse)
    solution, *_ = np.linalg.lstsq(square, right, rcond=1e-13)
    known = np.ones(grid, bool)
    expected = without_plane(solution[:size].reshape(grid), known)
    assert without_plane(found.reshape(grid), known) == pytest.approx(
        expected, abs=0.02 * rms(expected)
    )


def test_smoothness_does_not_punish_what_is_free():
    for grid in ((1, 1), (1, 8), (2, 3), (6, 9)):
        v, u = np.indices(grid).astype(float)
        for place, free in ((0, 2 * u - v + 3), (1, np.ones(grid))):
            assert free.ravel() @ _roughness(grid, place) @ free.ravel() == pytest.approx(
                0, abs=1e-9
            )
    offset, slope = (_roughness(u.shape, place) for place in (0, 1))

    def roughness(matrix, field):
        return field.ravel() @ (matrix @ field.ravel())

    # Second differences: none along rows and columns, 1 in each of 5 x 8 corners, counted twice.
    assert roughness(offset, u * v) == pytest.approx(2 * 5 * 8)
    assert roughness(offset, u * u) == pytest.approx(2**2 * 6 * 7)
    assert roughness(slope, u) == pytest.approx(6 * 8)


@pytest.mark.parametrize(
    ('options', 'words'),
    [
        ({'count': 6}, 'too few planes'),
        ({'count': 20, 'depths': (1.99, 2.0)}, 'too few ranges'),
    ],
)
def test_recordings_that_do_not_hold_it_are_refused_with_advice(options, words):
    cells = seen(options.pop('count'), true_map(), **options)
    if words == 'too few ranges':
        # Head-on, so that slant does not make distances.
        cells = cells._replace(inverse=np.full_like(cells.inverse, 0.5))
    with pytest.raises(CalibrationError, match=f'{words}.*record walls'):
        calibrate(cells, CAMERA.shape)


def test_views_of_one_corner_are_refused():
    def corner(frame):
        labels, image = frame
        labels[20:] = 0
        return labels, image

    cells = concatenate([find_sightings(*corner(f)) for f in frames(20, true_map())])
    with pytest.raises(CalibrationError, match='too few positions: planes cover'):
        calibrate(cells, CAMERA.shape)
