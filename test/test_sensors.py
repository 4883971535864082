"""The twins of the ABW and Perceptron scanners, and their files."""

import numpy as np
import pytest
from click.testing import CliRunner
from scanner_points import abw_points

from rangeseg_ros.cli.simulate import command
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.evaluation.datasets import find_cases
from rangeseg_ros.segcomp import files as segcomp
from rangeseg_ros.segcomp import geometry as geometry
from rangeseg_ros.simulation.scanners import (
    ABW_NOISE,
    ABW_PROJECTOR,
    PERCEPTRON_NOISE,
    Scan,
    abw_scene,
    perceptron_scene,
    simulate_abw,
    simulate_perceptron,
)
from rangeseg_ros.simulation.scenes import Pose, Scene
from rangeseg_ros.simulation.segcomp_truth import ground_truth, region_angles
from rangeseg_ros.simulation.solids import box, cast, half_space
from rangeseg_ros.simulation.truth import TruePlane

CALIBRATIONS = [geometry.ABW_FIRST, geometry.ABW_SECOND]


def in_sensor_frame(*solids):
    return Scene(solids, (Pose(np.eye(3), np.zeros(3)),))


def wall(z, tilt=0.0):
    angle = np.radians(tilt)
    return half_space((0, np.sin(angle), -np.cos(angle)), (0, 0, z))


@pytest.fixture(scope='module', params=range(2))
def abw(request):
    calibration = CALIBRATIONS[request.param]
    return simulate_abw(abw_scene(request.param), calibration, request.param), calibration


@pytest.fixture(scope='module')
def perceptron():
    return simulate_perceptron(perceptron_scene(0), 0)


def test_abw_points_lie_on_their_planes(abw):
    scan, calibration = abw
    points = abw_points(scan.values, calibration)
    depth_step = 1e-3 / calibration.scale
    assert max(plane.count for plane in scan.planes) > 20000
    for plane in scan.planes:
        mask = scan.labels == plane.label
        assert plane.distance > 0
        # Along the optical axis, in quanta: uniform rounding and normal noise.
        off = (points[mask] @ plane.normal + plane.distance) / plane.normal[2] / depth_step
        rays = points[mask] / points[mask][:, 2:]
        off *= plane.normal[2] / (rays @ plane.normal)
        assert np.abs(off).max() < 0.5 + 5 * ABW_NOISE
        if plane.count > 20000:
            assert off.std() == pytest.approx(np.hypot(1 / np.sqrt(12), ABW_NOISE), rel=0.1)


def test_perceptron_points_lie_on_their_planes(perceptron):
    rays = geometry.perceptron_rays()
    points = geometry.perceptron_points(perceptron.values)
    large = [plane for plane in perceptron.planes if plane.count >= 3000]
    assert large
    for plane in large:
        mask = perceptron.labels == plane.label
        cosine = -rays.directions[mask] @ plane.normal
        off = (points[mask] @ plane.normal + plane.distance) / cosine / 0.0020236
        distance = np.linalg.norm(points[mask] - rays.origins[mask], axis=-1)
        sigma = np.hypot(PERCEPTRON_NOISE * distance / 3 / np.sqrt(cosine), 1 / np.sqrt(12))
        # Robustly, since noise is larger along the borders.
        spread = 1.4826 * np.median(np.abs(off / sigma))
        assert 0.9 < spread < 1.3


def perceptron_error(*solids):
    """(512, 512) error of the range values, and what each pixel sees."""
    scan = simulate_perceptron(in_sensor_frame(*solids), 0)
    rays = geometry.perceptron_rays()
    distance, face = cast(solids, rays.origins, rays.directions)
    return scan.values - geometry.perceptron_values(distance), face


def test_perceptron_noise_is_three_times_as_large_beside_edges():
    error, face = perceptron_error(wall(4.0), box((4, 9, 1), np.eye(3), (2, 0, 4.3)))
    (column,) = set(np.argmax(face[100:400] > 0, axis=1))
    beside = error[100:400, column - 2 : column + 2]
    away = error[100:400, column - 30 : column - 5]
    assert beside.std() / away.std() == pytest.approx(3, abs=0.25)


def test_abw_shadow_is_as_wide_as_parallax():
    near, far = 0.9, 1.0
    plate = box((0.05, 0.05, 0.001), np.eye(3), (0, 0, near + 0.0005))
    scan = simulate_abw(in_sensor_frame(wall(far), plate), geometry.ABW_FIRST, 0)
    (hole,) = np.nonzero(scan.values[255] == 0)
    width = geometry.ABW_FIRST.focal * ABW_PROJECTOR[0] * (1 / near - 1 / far)
    assert (np.diff(hole) == 1).all()
    assert abs(len(hole) - width) <= 1
    # To the left of the plate, since the projector stands to the right.
    assert scan.labels[255, hole[-1] + 1] == scan.labels[255, 255]
    assert np.array_equal(scan.labels > 0, scan.values > 0)


def test_beyond_the_range_of_the_scanners():
    nothing = simulate_abw(in_sensor_frame(wall(2.0)), geometry.ABW_FIRST, 0)
    assert not nothing.values.any() and not nothing.labels.any() and nothing.planes == []
    for z in (1.0, 20.0):
        with pytest.raises(ValueError, match='range of the Perceptron'):
            simulate_perceptron(in_sensor_frame(wall(z)), 0)


def test_ground_truth_and_angles_of_a_small_image():
    labels = np.zeros((40, 40), np.uint16)
    labels[:, :20], labels[:20, 20:], labels[20:, 20:39] = 1, 2, 4
    labels[0, 0] = 3
    normals = [(0, 0, -1), (0, -1, 0), (0, 0, -1), (np.sqrt(0.75), 0, 0.5)]
    planes = [
        TruePlane(label, label, np.array(normal), 1.0, int((labels == label).sum()))
        for label, normal in enumerate(normals, start=1)
    ]
    image, kept = ground_truth(Scan(np.ones((40, 40), np.uint8), labels, planes))
    # The single pixel is left out, the last column of the lower half is shadow.
    assert [plane.label for plane in kept] == [10, 11, 12]
    assert image[0, 0] == 0 and image[1, 0] == 10 and image[0, 39] == 11
    assert image[39, 38] == 12 and image[39, 39] == segcomp.SHADOW
    assert region_angles(image, kept) == [
        (10, 11, pytest.approx(90)),
        (10, 12, pytest.approx(60)),
        (11, 12, pytest.approx(90)),
    ]


@pytest.mark.parametrize(('kind', 'prefix'), [('abw', 'abw'), ('perceptron', 'perc')])
def test_set_in_segcomp_files(tmp_path, kind, prefix):
    output = tmp_path / 'set'
    arguments = ['--scenes', '4', '--seed', '5', '--output', str(output)]
    result = CliRunner().invoke(command, [kind, *arguments])
    assert result.exit_code == 0, result.output
    assert [path.name for path in tmp_path.iterdir()] == ['set']
    cases = find_cases(output)
    assert {case.name for case in cases} == {
        f'{prefix}.{rest}' for rest in ('train.0', 'test.0', 'test.1', 'test.2')
    }
    for case in cases:
        sample = case.load()
        assert isinstance(sample.image, RangeImage)
        assert 4 <= sample.truth.labels.max() <= 30
        assert len(sample.angles) >= sample.truth.labels.max() - 1
        assert {round(angle.degrees) for angle in sample.angles} & {90}

    (case,) = (case for case in cases if case.name.endswith('test.0'))
    if kind == 'abw':
        # The second scene is test image 0, of the first calibration.
        scan = simulate_abw(abw_scene(6), geometry.ABW_FIRST, 6)
        values = segcomp.read_raster(case.image)
        shadow = segcomp.read_segmentation(case.truth) == segcomp.SHADOW
        assert np.array_equal(shadow, values == 0)
    else:
        scan = simulate_perceptron(perceptron_scene(6), 6)
        values = segcomp.read_perceptron(case.image)
    assert np.array_equal(values, scan.values)


def test_about_fifteen_regions():
    counts = []
    for seed in range(8):
        scan = simulate_abw(abw_scene(seed), geometry.ABW_SECOND, seed)
        counts.append(len(ground_truth(scan)[1]))
        assert 0.01 < (scan.labels == 0).mean() < 0.25
    # 15.2 on average in the real set; scenes scatter by 4.
    assert np.mean(counts) == pytest.approx(15.2, abs=3 * 4 / np.sqrt(len(counts)))
