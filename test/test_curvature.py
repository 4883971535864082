"""Curved regions are told from planes that the sensor bends."""

import numpy as np
import pytest

from rangeseg_ros.core.by_planes.curvature import find_curved
from rangeseg_ros.core.by_planes.quadratics import add_terms, explained, fitted, taken_off
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.fitting.borders import find_borders
from rangeseg_ros.core.fitting.first_planes import FirstPlanes
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.grid import weights
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.evaluation.overlap import Overlap
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import curved_scene
from rangeseg_ros.simulation.sensors.kinect import QUANTUM
from rangeseg_ros.simulation.truth import NOT_PLANAR

CAMERA = Camera(320, 240, 292.0, 292.0, 159.5, 119.5)
SENSOR = SensorModel.from_config(Config())
FLATNESS = Config().flatness


def cylinder(radius, distance=2.0):
    """Inverse depth of a standing cylinder, 0 beside it."""
    x = CAMERA.rays[..., 0].astype(float)
    # Nearer root of (z x)^2 + (z - c)^2 = r^2.
    centre = distance + radius
    root = centre**2 - (1 + x**2) * (centre**2 - radius**2)
    depth = (centre - np.sqrt(np.maximum(root, 0))) / (1 + x**2)
    return np.where(root > 0, 1 / depth, 0)


def verdict(inverse, regions, distortion=0.0, seed=0, parted=False):
    random = np.random.default_rng(seed)
    field = smooth_field(CAMERA.shape, (2.0, 2.0), random)
    bent = smooth_field(CAMERA.shape, (13.0, 22.0), random)
    inverse = inverse + (inverse > 0) * QUANTUM * (0.45 * field + distortion * bent)
    image = RangeImage(CAMERA.rays, inverse.astype(np.float32), CAMERA)
    regions, blocks = regions.astype(np.uint16), Blocks.of(image)
    return curved(regions, image, blocks, SENSOR, parted=parted)


def curved(regions, image, blocks, sensor, flatness=FLATNESS, parted=False):
    first = FirstPlanes.of(regions, image, blocks, sensor)
    grid = weights(image)
    if parted:
        grid.right[40:130] = 0
    borders = find_borders(regions, grid, len(first.theta))
    return find_curved(regions, first, borders, image, blocks, sensor, flatness)


def test_planes_are_not_curved():
    """Nor is what the sensor's own distortion bends."""
    regions = np.repeat([[1], [2]], [100, 140], axis=0) * np.ones((1, 320), int)
    inverse = np.where(
        regions == 1, CAMERA.rays @ np.array([0.1, 0, 0.5]), CAMERA.rays @ np.array([0, 0.4, 0.6])
    )
    for seed in range(3):
        assert verdict(inverse, regions, 0.5, seed).tolist() == [False] * 3


def test_regions_of_too_few_pixels_for_a_plane_are_not_curved():
    regions = np.zeros(CAMERA.shape, int)
    regions[100, 100], regions[110, 110:118], regions[111, 111] = 1, 2, 3
    inverse = CAMERA.rays @ np.array([0.1, 0, 0.5])
    assert verdict(inverse, regions).tolist() == [False] * 4


@pytest.mark.parametrize('radius', [0.15, 0.3])
def test_cylinders_are_curved(radius):
    inverse = cylinder(radius)
    assert verdict(inverse, inverse > 0, 0.5).tolist() == [False, True]


@pytest.mark.parametrize(('bend', 'expected'), [(0.005, False), (0.025, True)])
@pytest.mark.parametrize('angle', [0, 30, 60])
def test_a_bend_counts_across_the_plane_however_obliquely_it_is_seen(bend, expected, angle):
    """A sheet bent like a barrel, by a share of the square root of its area."""
    rays = CAMERA.rays.astype(float)
    turn = np.tan(np.radians(angle))
    flat = rays @ np.array([turn, 0, 1.0]) / 1.5
    seen = (np.abs(rays[..., :2]) < 0.1).all(axis=-1)
    distance = 1.5 * np.cos(np.radians(angle))
    area = (1 / (CAMERA.fx * CAMERA.fy * distance * flat[seen] ** 3)).sum()
    barrel = (rays[..., 1][seen] / flat[seen]) ** 2
    barrel -= barrel.mean()
    inverse = np.zeros(CAMERA.shape)
    height = bend * np.sqrt(area) * barrel / barrel.std()
    inverse[seen] = flat[seen] * (1 + height / distance)
    assert verdict(inverse, seen).tolist() == [False, expected]


@pytest.mark.parametrize(('distortion', 'flatness'), [(0.005, 0.0), (0.0, 0.02)])
def test_holes_make_no_region_smaller(distortion, flatness):
    """Of a sheet that bends more and more, the same bend is too much with a third missing."""
    sensor = SENSOR._replace(noise=0.005, distortion=distortion)
    seen = np.zeros(CAMERA.shape, bool)
    seen[60:180, 80:240] = True
    barrel = CAMERA.rays[..., 0].astype(float) ** 2
    least = []
    for holes in (0.0, 0.33):
        measured = seen & (np.random.default_rng(1).random(CAMERA.shape) >= holes)
        for bend in np.geomspace(0.01, 2.0, 150):
            inverse = np.where(measured, 0.8 + bend * barrel, 0).astype(np.float32)
            image = RangeImage(CAMERA.rays, inverse, CAMERA)
            blocks = Blocks.of(image)
            # What is missing is bridged.
            image = RangeImage(CAMERA.rays, (0.8 + bend * barrel).astype(np.float32), CAMERA)
            if curved(seen.astype(np.uint16), image, blocks, sensor, flatness)[1]:
                break
        least.append(bend)
    assert 0.01 < least[0] < 1
    assert least[1] == pytest.approx(least[0], rel=0.08)


def test_only_the_curved_region_is():
    inverse = cylinder(0.25)
    regions = np.where(inverse > 0, 2, 1)
    inverse[regions == 1] = (CAMERA.rays @ np.array([0.05, 0, 0.3]))[regions == 1]
    assert verdict(inverse, regions).tolist() == [False, False, True]


def test_first_planes_are_those_of_every_pixel():
    """Of stripes with holes, most of which fill no block: sums over their pixels one by one."""
    draw = np.random.default_rng(0)
    theta = draw.normal((0, 0, 0.6), 0.1, (6, 3))
    regions = np.arange(320)[None] // draw.integers(2, 30, (240, 1)) % 6
    regions[:40, :50] = 5
    inverse = (theta[regions] * CAMERA.rays).sum(axis=2) + draw.normal(0, 0.002, CAMERA.shape)
    inverse = np.where(draw.random(CAMERA.shape) < 0.1, 0, inverse).astype(np.float32)
    image = RangeImage(CAMERA.rays, inverse, CAMERA)
    first = FirstPlanes.of(regions.astype(np.uint16), image, Blocks.of(image), SENSOR, stride=1)
    assert first.filled.max() == 5 and np.count_nonzero(first.filled) < 200
    for k in range(1, 6):
        pixels = (regions == k) & (inverse > 0)
        found = np.linalg.lstsq(CAMERA.rays[pixels], inverse[pixels], rcond=None)[0]
        np.testing.assert_allclose(first.theta[k], found, atol=1e-5)


def strips(count, first=60, after=260, rows=slice(40, 200)):
    """Upright strips side by side, of the same width."""
    regions = np.zeros(CAMERA.shape, int)
    regions[rows, first:after] = 1 + np.arange(after - first) * count // (after - first)
    return regions


@pytest.mark.parametrize(('radius', 'half', 'count'), [(0.3, 29, 3), (0.5, 51, 4), (1.2, 100, 4)])
@pytest.mark.parametrize('seed', [0, 1])
def test_facets_bend_together_that_alone_bend_too_little(radius, half, count, seed):
    inverse, regions = cylinder(radius), strips(count, 160 - half, 160 + half)
    for k in range(1, count + 1):
        assert verdict(inverse, regions == k, seed=seed).tolist() == [False, False]
    assert verdict(inverse, regions, seed=seed).tolist() == [False] + [True] * count
    # Where jumps part them along most of their borders they are surfaces of their own.
    assert not verdict(inverse, regions, seed=seed, parted=True).any()


def test_facets_touch_along_their_width():
    inverse = cylinder(1.2)
    left, right = strips(4) * (strips(4) <= 2), strips(4) * (strips(4) > 2)
    left[110:], right[:90] = 0, 0
    assert verdict(inverse, left + right).tolist() == [False] + [True] * 4
    left[:] = strips(4, rows=slice(20, 110)) * (strips(4, rows=slice(20, 110)) == 2)
    right[:] = strips(4, rows=slice(90, 180)) * (strips(4, rows=slice(90, 180)) == 3)
    assert not verdict(inverse, left + right).any()


@pytest.mark.parametrize('angle', [8, 20, 60])
@pytest.mark.parametrize('seed', [0, 1, 2])
def test_faces_that_meet_in_a_crease_are_no_facets(angle, seed):
    """Though the sensor bends them."""
    turned = CAMERA.rays @ np.array([0.5 * np.tan(np.radians(angle)), 0, 0.5])
    inverse = np.maximum(turned, CAMERA.rays @ np.array([0, 0, 0.5]))
    assert verdict(inverse, strips(2), 0.5, seed).tolist() == [False] * 3


def test_small_faces_are_facets_only_where_that_is_significant():
    """Of 20 x 10 pixels each, of which noise alone makes a quadratic the better one at times."""
    turned = CAMERA.rays @ np.array([0.5 * np.tan(np.radians(40)), 0, 0.5])
    inverse = np.maximum(turned, CAMERA.rays @ np.array([0, 0, 0.5]))
    regions = strips(2, 150, 170, slice(110, 130))
    for seed in range(30):
        assert not verdict(inverse, regions, seed=seed).any()


def test_beside_what_bends_less_is_enough():
    """Two small facets are not sure by themselves."""
    facets = np.zeros(CAMERA.shape, int)
    facets[100:140, 150:175], facets[100:140, 175:190] = 1, 2
    assert not verdict(cylinder(0.5), facets).any()
    facets[100:140, 110:150] = 3
    assert verdict(cylinder(0.5), facets).tolist() == [False, True, True, True]


@pytest.mark.parametrize('tilt', [0.15, 0.2, 0.4])
def test_a_narrow_face_beside_what_bends_is_kept(tilt):
    """One quadratic explains both better, but not the face."""
    regions = strips(1, 60, 230) + 2 * strips(1, 230, 236)
    x = CAMERA.rays[..., 0].astype(float)
    inverse = 0.5 + 0.3 * (x + 0.05) ** 2 + tilt * np.maximum(x - x[0, 230], 0)
    assert verdict(inverse, regions).tolist() == [False, True, False]


def test_a_plane_that_goes_over_into_a_curve_is_one():
    """The rounded edge of a board."""
    inverse = np.where(CAMERA.rays[..., 0] < 0, 0.5, cylinder(0.3))
    regions = np.where(strips(1, 60, 160) > 0, 1, strips(2, 160, 200) + (strips(2, 160, 200) > 0))
    assert verdict(inverse, regions).tolist() == [False, False, True, True]


def test_the_background_never_is():
    inverse = cylinder(0.25)
    assert verdict(inverse, np.zeros(CAMERA.shape)).tolist() == [False]


def test_ball_and_cylinder_make_no_planes_and_planes_survive():
    """The targets: of curved surfaces at most 10 % in planes of 3000 pixels or more."""
    shares, overlaps = [], []
    for seed in (900, 901, 902):
        frame = simulate_kinect(curved_scene(seed), seed=seed, sensor_seed=seed)
        image = RangeImage.from_depth(frame.depth, frame.camera)
        labels = Segmenter().segment(image).labels
        large = np.flatnonzero(np.bincount(labels.ravel()) >= 3000)
        curve = frame.labels == NOT_PLANAR
        shares.append(np.isin(labels[curve], large[large > 0]).mean())
        size = np.bincount(frame.labels.ravel(), minlength=NOT_PLANAR + 1)
        overlap = Overlap.between(frame.labels, labels, frame.labels > 0)
        counts = (overlap.truth != NOT_PLANAR) & (size[overlap.truth] >= 1000)
        overlaps.extend(overlap.best_iou[counts])
    assert np.mean(shares) <= 0.1
    assert len(overlaps) >= 15
    assert np.mean(overlaps) >= 0.9


def test_pixels_left_out_do_not_bend_the_rest():
    """A strip of outliers tilts the plane of the fit, off which the rest then lies, but flat."""
    inverse = np.full(CAMERA.shape, 0.5)
    inverse[:, 130:136] += 0.04
    regions = np.zeros(CAMERA.shape, int)
    regions[90:150, 130:190] = 1
    assert verdict(inverse, regions).tolist() == [False, False]


def test_what_a_quadratic_explains_is_what_least_squares_explain():
    random = np.random.default_rng(5)
    x, y, residual = random.uniform(-1, 1, (3, 200))
    normal, right = np.zeros(15), np.zeros(6)
    for a, b, c in zip(x, y, residual, strict=True):
        add_terms(normal, right, b, (1.0, a, a * a, a**3, a**4), (c, c * a, c * a * a))
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    values = [
        terms[:, :count] @ np.linalg.lstsq(terms[:, :count], residual, rcond=None)[0]
        for count in (3, 6)
    ]
    flat, whole = ((part**2).sum() for part in values)
    np.testing.assert_allclose(explained(normal, right), (flat, whole - flat), rtol=1e-6)
    quadratic = np.linalg.lstsq(terms, residual, rcond=None)[0]
    np.testing.assert_allclose(fitted(normal, right), quadratic, rtol=1e-6)
    other = random.uniform(-1, 1, 6)
    less, square = taken_off(normal, right, (residual**2).sum(), other)
    left = residual - terms @ other
    np.testing.assert_allclose(less, terms.T @ left, atol=1e-9)
    assert square == pytest.approx((left**2).sum())
