"""Planes told from curved surfaces, and shifted to what is measured of them near by."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rangeseg_ros import Camera, Config, RangeImage, Segmenter
from rangeseg_ros.core.by_planes.posterior import _evidence, plane_probabilities
from rangeseg_ros.core.by_planes.shifts import shift_at, shifts
from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.fitting.region_sums import INVERSE, PLACE, RAY, WEIGHT
from rangeseg_ros.core.sensing.moments import COUNT, RATIO
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance
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
    depth = (centre - np.sqrt(np.maximum(root, 0))) / (1 + X**2)
    return np.where(root > 0, 1 / depth, 0)


NO_PAIRS = np.zeros((0, 2), np.uint16)


def fitted(inverse, regions, seed=0):
    random = np.random.default_rng(seed)
    error = 0.45 * smooth_field(CAMERA.shape, (2.0, 2.0), random)
    error += 0.5 * smooth_field(CAMERA.shape, (13.0, 22.0), random)
    seen = np.where(inverse > 0, inverse + QUANTUM * error, 0).astype(np.float32)
    return Fits.of(regions.astype(np.uint16), RangeImage(CAMERA.rays, seen, CAMERA), SENSOR)


def probabilities(inverse, regions, seed=0, pairs=NO_PAIRS):
    return plane_probabilities(fitted(inverse, regions, seed), np.array(pairs, np.uint16), 0.5)


@pytest.mark.parametrize('seed', range(3))
def test_planes_that_the_sensor_bends_are_planes(seed):
    regions = np.ones(CAMERA.shape, int)
    regions[100:, :] = 2
    inverse = np.where(regions == 1, WALL, CAMERA.rays @ np.array([0, 0.4, 0.6]))
    assert (probabilities(inverse, regions, seed)[1:] > 0.5).all()


@pytest.mark.parametrize('bend', [0.08, 0.2])
def test_rows_and_columns_are_alike(bend):
    """A tilted and bent surface is as probably a plane where rows and columns are exchanged."""
    camera, whole = Camera(120, 120, 150.0, 150.0, 59.5, 59.5), np.ones((120, 120), np.uint16)
    sensor, rays = SensorModel.from_config(Config(), camera.shape), camera.rays.astype(float)
    inverse = rays @ np.array([0.5, 0.1, 0.5]) + bend * (rays[..., :2] ** 2 @ np.array([1, 0.5]))

    def probability(inverse):
        image = RangeImage(camera.rays, inverse.astype(np.float32), camera)
        return plane_probabilities(Fits.of(whole, image, sensor), NO_PAIRS, 0.5)[1]

    one, other = probability(inverse), probability(inverse.T)
    assert one == pytest.approx(other, rel=1e-6) and 0.2 < one < 0.9


@pytest.mark.parametrize('radius', [0.3, 0.5])
@pytest.mark.parametrize('seed', range(2))
def test_cylinders_are_none(radius, seed):
    inverse = cylinder(radius)
    assert probabilities(inverse, inverse > 0, seed)[1] < 0.3


def folded(angle, column=160):
    """Two walls, 2 m away, that meet at an angle in a column; regions 1 and 2."""
    beyond, half = X - X[0, column], np.tan(np.radians(angle / 2))
    return 0.5 * (1 - half * np.abs(beyond)), np.where(beyond < 0, 1, 2)


@pytest.mark.parametrize('angle', [8, 20, 60, 120])
@pytest.mark.parametrize('column', [60, 160])
def test_walls_that_meet_are_planes(angle, column):
    inverse, regions = folded(angle, column)
    alone, beside = probabilities(inverse, regions), probabilities(inverse, regions, 0, [[1, 2]])
    np.testing.assert_allclose(beside, alone, atol=1e-6)
    assert (alone[1:] > 0.5).all()


@pytest.mark.parametrize(('radius', 'distance'), [(0.3, 1.5), (0.5, 1.5), (1.0, 2.0)])
def test_facets_of_a_cylinder_are_no_planes_together(radius, distance):
    """Each of three strips by itself may be a plane."""
    inverse, columns = cylinder(radius, distance), np.arange(320)
    seen = np.flatnonzero(inverse[0])
    regions = np.where(inverse > 0, 1 + (columns - seen[0]) * 3 // len(seen), 0)
    alone = probabilities(inverse, regions)
    together = probabilities(inverse, regions, 0, [[1, 2], [2, 3]])
    assert (alone[1:] > 0.5).all() and (together[1:] < 0.2).all()


def test_a_wall_that_goes_on_as_a_fillet_is_a_plane():
    """A wall, the quarter of a cylinder that touches it, and a wall at a right angle."""
    radius, depth = 0.5, 2.0
    # z = depth up to x = 0; (z x)^2 + (z - depth + radius)^2 = radius^2 beyond.
    centre = depth - radius
    root = centre**2 - (1 + X**2) * (centre**2 - radius**2)
    bent = (centre + np.sqrt(np.maximum(root, 0))) / (1 + X**2)
    inverse = 1 / np.where(X < 0, depth, bent)
    regions = np.select([X < 0, X < 0.13], [1, 2])
    alone, beside = probabilities(inverse, regions), probabilities(inverse, regions, 0, [[1, 2]])
    assert beside[1] == pytest.approx(alone[1], abs=0.01) and beside[1] > 0.5


@pytest.mark.parametrize('slope', [0.02, 0.1, 0.2])
def test_a_bowed_wall_beside_what_does_not_go_on_is_a_plane(slope):
    """The wall bends towards its neighbour, which is flat."""
    beyond, columns = X - X[0, 270], np.arange(320)
    inverse = 0.5 + np.where(beyond < 0, 0.04 * beyond**2, slope * beyond)
    regions = np.where(beyond < 0, 1, 2) * (columns < 310)
    alone, beside = probabilities(inverse, regions), probabilities(inverse, regions, 0, [[1, 2]])
    np.testing.assert_allclose(beside, alone, atol=0.01)
    assert alone[1] > 0.5


def test_the_evidence_is_that_of_residuals_along_the_crease():
    """Against least squares of all cells at once."""
    inverse = 0.5 + 0.05 * X - 0.2 * X**2 - 0.05 * X * CAMERA.rays[..., 1]
    sums, _, theta, *_ = fitted(inverse, np.where(X < 0.1, 1, 2))
    found = _evidence(sums, 1, 2, theta, SENSOR, SENSOR.correlated)
    parts = [sums.cells[sums.start[k] : sums.start[k + 1]] for k in (1, 2)]
    cells, part = np.vstack(parts), np.repeat([0, 1], [len(one) for one in parts])
    root = np.sqrt(cells[:, COUNT])
    level = cells[:, RAY:INVERSE] @ theta[1:].T / cells[:, WEIGHT, None]
    deviation = np.sqrt(random_variance(SENSOR, level**2))
    residual = (cells[:, INVERSE] / cells[:, WEIGHT])[:, None] - level
    residual *= root[:, None] / deviation
    own, other = residual[np.arange(len(part)), part], residual[:, 0]
    planes = np.where(part == 0, 0, other - own)
    v, u = (cells[:, PLACE + k] / cells[:, COUNT] / 100 for k in range(2))
    terms = root[:, None] * np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    crease = planes - terms @ np.linalg.lstsq(terms, planes, rcond=None)[0]
    for k in range(2):
        mine = part == k
        noise = max(SENSOR.correlated, own[mine] @ own[mine] / (mine.sum() - 3))
        ratio = own[mine] @ own[mine] - ((own + crease)[mine] ** 2).sum()
        assert found[k] == pytest.approx(ratio / (2 * noise), rel=1e-5)
    assert min(found) > 0


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
    # Nor does it tell anything of what it touches.
    regions[100:140, 101:160] = 2
    alone, beside = probabilities(WALL, regions), probabilities(WALL, regions, 0, [[1, 2]])
    assert beside.tolist() == alone.tolist()


def test_shifts_are_the_weighted_residuals_around():
    random = np.random.default_rng(3)
    rows, columns, agreement = 11, 13, 5.0
    surfaces = np.zeros((rows, columns), np.int32)
    surfaces[:, :6], surfaces[2:9, 6:], surfaces[9, 9] = 1, 2, 1
    theta = np.array([[0, 0, 0], [0.02, -0.01, 0.5], [-0.1, 0.05, 0.45]])
    blocks = np.zeros((rows, columns, 13))
    rays, residuals = {}, {}
    for place in np.ndindex(rows, columns):
        ray = random.normal([0, 0, 1], 0.3, (16, 3))
        residual = random.normal(0.002, 0.01, 16)
        rays[place], residuals[place] = ray, residual
        y = ray @ theta[surfaces[place]] + residual
        square = np.einsum('ni,nj->ij', ray, ray)[np.triu_indices(3)]
        blocks[place] = [*square, *(y @ ray), y @ y, 16, 32, 0]
    found = shifts(surfaces, blocks, theta, 2, 3, agreement)
    for place in np.ndindex(rows, columns):
        for label in (1, 2):
            level, residual, ratio = [], [], 0.0
            for near in np.ndindex(rows, columns):
                i, j = near
                window = surfaces[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
                if surfaces[near] != label or not np.isin(window, (0, label)).all():
                    continue
                if max(abs(i - place[0]), abs(j - place[1])) <= 3:
                    level.append(rays[near] @ theta[label])
                    residual.append(residuals[near])
                    ratio += blocks[near][RATIO]
            expected = 0.0
            if level:
                fit = np.ravel(level) @ np.ravel(residual) / np.square(level).sum()
                expected = fit * ratio / (ratio + agreement)
            own = np.argwhere(surfaces == label)
            inside = (own.min(0) - 2 <= place).all() and (place <= own.max(0) + 2).all()
            value = shift_at(found, label, *place)
            np.testing.assert_allclose(value, expected if inside else 0, rtol=1e-4, atol=1e-9)


def test_a_crease_stays_in_its_place_where_the_sensor_bends_the_planes():
    """Two walls at 4 m that meet at a right angle, under the distortion of a bad Kinect."""
    camera = Camera(640, 480, 585.0, 585.0, 319.5, 239.5)
    column = camera.rays[..., 0]
    away = []
    for seed in range(3):
        random = np.random.default_rng(seed)
        bent = gaussian_filter(random.normal(size=(480, 640)), 35)
        noise = gaussian_filter(random.normal(size=(480, 640)), 2)
        inverse = 0.25 + np.abs(column) * 0.25
        inverse = inverse + 0.002 * bent / bent.std() + 0.0012 * noise / noise.std()
        image = RangeImage.from_depth((1 / inverse).astype(np.float32), camera)
        labels = Segmenter().segment(image).labels
        edge = (labels[:, 1:] != labels[:, :-1]) & (np.abs(column[:, 1:]) < 0.1)
        distance = np.abs(np.arange(639) - 319)
        away.append(np.where(edge, distance, 99).min(axis=1))
    # Without shifts, half.
    assert np.mean(np.array(away) <= 2) > 0.75
