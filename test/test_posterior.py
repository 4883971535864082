"""Planes told from curved surfaces, and shifted to what is measured of them near by."""

import numpy as np
import pytest
from planes_of_labels import fits_of
from scipy.ndimage import binary_dilation, convolve, find_objects

from rangeseg_ros import Camera, Config, RangeImage, Segmenter
from rangeseg_ros.core.by_planes.offsets import local_offsets, offset_at
from rangeseg_ros.core.by_planes.posterior import _evidence, calibrated, plane_posteriors
from rangeseg_ros.core.fitting.region_sums import INVERSE, PLACE, RAY, WEIGHT
from rangeseg_ros.core.sensing.moments import COUNT, RATIO
from rangeseg_ros.core.sensing.sensor import SensorModel, distortion_share, random_variance
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.sensors.kinect import QUANTUM

CAMERA = Camera(320, 240, 292.0, 292.0, 159.5, 119.5)
SENSOR = SensorModel.from_config(Config(), CAMERA.shape)
X = CAMERA.rays[..., 0].astype(float)
WALL = CAMERA.rays.astype(float) @ np.array([0.1, 0, 0.5])


def cylinder(radius, distance=2.0):
    """Inverse depth of a standing cylinder, 0 beside it."""
    # Nearer root of (z x)^2 + (z - c)^2 = r^2.
    centre = distance + radius
    root = centre**2 - (1 + X**2) * (centre**2 - radius**2)
    return np.where(root > 0, (1 + X**2) / (centre - np.sqrt(np.maximum(root, 0))), 0)


NO_PAIRS = np.zeros((0, 2), np.uint16)


def fitted(inverse, regions, seed=0, times=1):
    """Fits where the sensor bends planes so many times as much as a Kinect."""
    random = np.random.default_rng(seed)
    error = 0.45 * smooth_field(CAMERA.shape, (2.0, 2.0), random)
    error += 0.5 * times * smooth_field(CAMERA.shape, (13.0, 22.0), random)
    seen = np.where(inverse > 0, inverse + QUANTUM * error, 0).astype(np.float32)
    sensor = SENSOR._replace(distortion=times * SENSOR.distortion)
    return fits_of(regions.astype(np.uint16), RangeImage(CAMERA.rays, seen, CAMERA), sensor)


def probabilities(inverse, regions, seed=0, pairs=NO_PAIRS, times=1):
    return plane_posteriors(fitted(inverse, regions, seed, times), np.array(pairs, np.uint16))


def alone_and_beside(inverse, regions, *pairs):
    """Probabilities of regions by themselves, and with those that they touch."""
    return [probabilities(inverse, regions, 0, touching) for touching in (NO_PAIRS, pairs)]


@pytest.mark.parametrize('seed', range(3))
def test_planes_that_the_sensor_bends_are_planes_and_cylinders_none(seed):
    regions = np.where(np.indices(CAMERA.shape)[0] < 100, 1, 2)
    inverse = np.where(regions == 1, WALL, CAMERA.rays @ np.array([0, 0.4, 0.6]))
    assert (probabilities(inverse, regions, seed, times=16)[1:] > 0.5).all()
    for inverse in (cylinder(0.3), cylinder(0.5)):
        assert probabilities(inverse, inverse > 0, seed)[1] < 0.3
    # Small blocks show a part of the distortion: it is as much, or surfaces bend the large ones.
    fits, half = fitted(inverse, inverse > 0), SENSOR.distortion / 2
    parts = SENSOR, SENSOR._replace(unbent=0.25), SENSOR._replace(distortion=half)
    found = [plane_posteriors(fits._replace(sensor=s), NO_PAIRS)[1] for s in parts]
    assert found[2] < found[1] < found[0]


def test_evidence_moves_the_calibrated_odds_evenly():
    found = calibrated(np.array([0, 0.2, 0.5, 0.8, 1]))
    odds = np.log(found[1:4] / (1 - found[1:4]))
    assert (found[0], found[4]) == (0, 1) and np.diff(odds) == pytest.approx(2.6 * np.log([4, 4]))
    assert 0 < found[2] - Config().plane_probability < 0.001


@pytest.mark.parametrize('bend', [0.08, 0.15])
def test_rows_and_columns_are_alike(bend):
    """A tilted and bent surface is as probably a plane where rows and columns are exchanged."""
    camera, whole = Camera(120, 120, 150.0, 150.0, 59.5, 59.5), np.ones((120, 120), np.uint16)
    sensor, rays = SensorModel.from_config(Config(), camera.shape), camera.rays.astype(float)
    inverse = rays @ np.array([0.5, 0.1, 0.5]) + bend * (rays[..., :2] ** 2 @ np.array([1, 0.5]))

    def probability(inverse):
        image = RangeImage(camera.rays, inverse.astype(np.float32), camera)
        return plane_posteriors(fits_of(whole, image, sensor), NO_PAIRS)[1]

    one, other = probability(inverse), probability(inverse.T)
    assert one == pytest.approx(other, rel=1e-6) and 0.2 < one < 0.9


@pytest.mark.parametrize('angle', [8, 20, 60, 120])
@pytest.mark.parametrize('column', [60, 160])
def test_walls_that_meet_are_planes(angle, column):
    beyond, half = X - X[0, column], np.tan(np.radians(angle / 2))
    inverse = 0.5 * (1 - half * np.abs(beyond))
    alone, beside = alone_and_beside(inverse, np.where(beyond < 0, 1, 2), [1, 2])
    np.testing.assert_allclose(beside, alone, atol=1e-6)
    assert (alone[1:] > 0.5).all()


@pytest.mark.parametrize(('radius', 'distance'), [(0.3, 1.5), (0.5, 1.5), (1.0, 2.0)])
def test_facets_of_a_cylinder_are_no_planes_together(radius, distance):
    """Each of three strips by itself may be a plane."""
    inverse, columns = cylinder(radius, distance), np.arange(320)
    seen = np.flatnonzero(inverse[0])
    regions = np.where(inverse > 0, 1 + (columns - seen[0]) * 3 // len(seen), 0)
    alone, together = alone_and_beside(inverse, regions, [1, 2], [2, 3])
    assert (alone[1:] > 0.5).all() and (together[1:] < 0.2).all()


def test_the_evidence_is_that_of_residuals_along_the_crease():
    """Against least squares of all cells at once."""
    inverse = 0.5 + 0.05 * X - 0.2 * X**2 - 0.05 * X * CAMERA.rays[..., 1]
    sums, _, theta, *_ = fitted(inverse, np.where(X < 0.1, 1, 2))
    sensor = SENSOR._replace(range_noise=0.01)
    found = _evidence(sums, 1, 2, theta, sensor, sensor.region_inflation)
    parts = [sums.cells[sums.start[k] : sums.start[k + 1]] for k in (1, 2)]
    cells, part = np.vstack(parts), np.repeat([0, 1], [len(one) for one in parts])
    root = np.sqrt(cells[:, COUNT])
    level = cells[:, RAY:INVERSE] @ theta[1:].T / cells[:, WEIGHT, None]
    deviation = np.sqrt(random_variance(sensor, level**2))
    residual = (cells[:, INVERSE] / cells[:, WEIGHT])[:, None] - level
    residual *= root[:, None] / deviation
    own = residual[np.arange(len(part)), part]
    planes = residual[:, 0] - own
    v, u = (cells[:, PLACE + k] / cells[:, COUNT] / 100 for k in range(2))
    terms = root[:, None] * np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    crease = planes - terms @ np.linalg.lstsq(terms, planes, rcond=None)[0]
    ratio, expected = own**2 - (own + crease / 2) ** 2, 0.0
    for mine in (part == 0, part == 1):
        noise = max(sensor.region_inflation, own[mine] @ own[mine] / (mine.sum() - 3))
        smooth = 2 * distortion_share(cells[mine, COUNT].sum(), sensor.distortion_pixels)
        expected += ratio[mine].sum() / (2 * noise * max(smooth, 1))
    assert found == pytest.approx(expected) and found > 0


@pytest.mark.parametrize(('bend', 'width'), [(1.0, 0.15), (1.0, 0.1), (0.5, 0.1), (0.2, 0.08)])
def test_two_regions_are_one_surface_as_far_as_their_evidence_says(bend, width):
    """By Bayes' theorem, over all that the two may be."""
    inverse = 0.5 + 0.05 * X - bend * X**2 - 0.05 * X * CAMERA.rays[..., 1]
    inside = (-0.6 * width < X) & (width > X) & (abs(CAMERA.rays[..., 1]) < width)
    regions = np.where(X < 0, 1, 2) * inside
    sums, _, theta, *_ = fitted(inverse, regions)
    ratio = np.exp(_evidence(sums, 1, 2, theta, SENSOR, SENSOR.region_inflation))
    alone, beside = alone_and_beside(inverse, regions, [1, 2])
    joint = np.outer([alone[1], 1 - alone[1]], [alone[2], 1 - alone[2]]) * [[1, 1], [1, ratio]]
    found = joint.sum(axis=1)[0], joint.sum(axis=0)[0]
    assert beside[1:] == pytest.approx(np.minimum(found / joint.sum(), alone[1:]))


def test_what_tells_nothing_has_the_prior():
    regions = np.zeros(CAMERA.shape, int)
    regions[100, 100] = 1
    assert probabilities(WALL, regions).tolist() == [0.0, 0.5]
    # Nor does it tell anything of what it touches.
    regions[100:140, 101:160] = 2
    np.testing.assert_array_equal(*alone_and_beside(WALL, regions, [1, 2]))


def test_offsets_are_the_weighted_residuals_around():
    """Of blocks that are not beside another surface."""
    random = np.random.default_rng(3)
    surfaces = np.zeros((11, 13), np.int32)
    surfaces[:, :6], surfaces[2:7, 6:], surfaces[7, 9] = 1, 2, 1
    theta = np.array([[0, 0, 0], [0.02, -0.01, 0.5], [-0.1, 0.05, 0.45]])
    rays = random.normal([0, 0, 1], 0.3, (11, 13, 16, 3))
    residual = random.normal(0.002, 0.01, (11, 13, 16))
    y = (rays * theta[surfaces][:, :, None]).sum(axis=3) + residual
    row, column = np.triu_indices(3)
    square = (rays[..., row] * rays[..., column]).sum(axis=2)
    linear = (rays * y[..., None]).sum(axis=2)
    blocks = np.dstack([square, linear, (y**2).sum(axis=2), np.tile([16, 32, 0], (11, 13, 1))])
    found = local_offsets(surfaces, blocks, theta, 2, 3, 5.0)
    for label in (1, 2):
        mine = surfaces == label
        inner = mine & ~binary_dilation((surfaces > 0) & ~mine, np.ones((3, 3)))
        level = rays @ theta[label]
        parts = (level * residual).sum(axis=2), (level**2).sum(axis=2), blocks[..., RATIO]
        leaves, weight, ratio = (
            convolve(inner * part, np.ones((7, 7)), mode='constant') for part in parts
        )
        expected = leaves / np.maximum(weight, 1e-9) * ratio / (ratio + 5.0)
        near = np.zeros(surfaces.shape, bool)
        near[find_objects(surfaces)[label - 1]] = True
        expected[~binary_dilation(near, np.ones((5, 5)))] = 0
        values = [offset_at(found, label, *place) for place in np.ndindex(surfaces.shape)]
        np.testing.assert_allclose(values, expected.ravel(), rtol=1e-4, atol=1e-9)


def test_a_crease_stays_in_its_place_where_the_sensor_bends_the_planes():
    """Two walls at 4 m that meet at a right angle, under the distortion of a bad Kinect."""
    camera = Camera(640, 480, 585.0, 585.0, 319.5, 239.5)
    column = camera.rays[..., 0]
    away = []
    for seed in range(3):
        random = np.random.default_rng(seed)
        bent, noise = (smooth_field(camera.shape, (w, w), random) for w in (35.0, 2.0))
        inverse = 0.25 + 0.25 * np.abs(column) + 0.002 * bent + 0.0012 * noise
        image = RangeImage.from_depth((1 / inverse).astype(np.float32), camera)
        edge = (np.diff(Segmenter().segment(image).labels) != 0) & (np.abs(column[:, 1:]) < 0.1)
        away.append(np.where(edge, np.abs(np.arange(639) - 319), 99).min(axis=1))
    # Without offsets, half.
    assert np.mean(np.array(away) <= 2) > 0.75
