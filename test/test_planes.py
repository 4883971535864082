"""Planes: fit, place, shape and common surfaces, and covariances against exact sums and errors."""

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
from clouds import cloud_of
from planes_of_labels import fit_planes
from scipy.spatial.transform import Rotation

from rangeseg_ros import Camera, RangeImage
from rangeseg_ros.core.by_planes.surfaces import unite_regions
from rangeseg_ros.core.fitting.region_sums import POINT, sum_regions
from rangeseg_ros.core.fitting.uncertainty import plane_jacobians, roots, squares
from rangeseg_ros.core.sensing.blocks import Blocks
from rangeseg_ros.core.sensing.grid import View, grid_of
from rangeseg_ros.core.sensing.moments import COUNT, RATIO
from rangeseg_ros.core.sensing.sensor import SensorModel, random_variance, systematic_variance
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.sensors.kinect import QUANTUM, kinect_camera

KINECT = SensorModel(0.45 * QUANTUM, 0, 0.33, 2, 0.5 * QUANTUM, 0, 35)
CAMERA = kinect_camera()
NORMAL, DISTANCE = np.array([0.36, -0.48, -0.8]), 2.0


def plane_image(distance=DISTANCE, error=0.0, normal=NORMAL):
    """Range image of a plane."""
    exact = -(CAMERA.rays.astype(float) @ normal) / distance
    return RangeImage(CAMERA.rays, (exact + error).astype(np.float32), CAMERA)


def boxes(*corners):
    labels = np.zeros(CAMERA.shape, np.uint16)
    for label, (top, left, bottom, right) in enumerate(corners, 1):
        labels[top:bottom, left:right] = label
    return labels


AS_CAMERA_OR_CLOUD = [lambda image: image, lambda image: cloud_of(image.points)]
FORMS = pytest.mark.parametrize('form', AS_CAMERA_OR_CLOUD, ids=['camera', 'cloud'])


@pytest.mark.parametrize('degrees', [*range(0, 180, 20), 84, 88])
def test_the_length_points_to_the_right_of_the_image(degrees):
    corners = cv2.boxPoints(((320, 240), (180, 40), degrees)).round().astype(int)
    labels = cv2.fillPoly(np.zeros(CAMERA.shape, np.uint8), [corners], 1)
    image = plane_image(normal=np.array([0.48, -0.6, -0.64]))
    (plane,) = fit_planes(labels.astype(np.uint16), image, KINECT)
    assert plane.shape.frame[0, 0] > 0 and plane.extents[0] > 2 * plane.extents[1]


@FORMS
def test_exact_planes_come_back(form):
    labels = boxes((50, 60, 250, 300), (300, 400, 316, 420))
    labels[100:140, 100:150] = 0
    labels[50:120, 200:300] = 0  # concave
    labels[200, 80] = 0  # a pixel is no hole
    image = form(plane_image())
    planes = fit_planes(labels, image, KINECT)
    for plane in planes:
        np.testing.assert_allclose(plane.normal, NORMAL, atol=1e-6)
        assert plane.distance == pytest.approx(DISTANCE, abs=1e-6)
        assert plane.rms < 1e-6 and plane.confidence == pytest.approx(1)
        assert plane.count == np.count_nonzero(labels == plane.label)
        points = image.points[labels == plane.label]
        # Of blocks inside regions, the sums tell where their middle is.
        np.testing.assert_allclose(plane.centroid, points.mean(axis=0, dtype=float), atol=5e-5)
        for ring in (plane.hull, *plane.holes, plane.centre[None], plane.centroid[None]):
            np.testing.assert_allclose(ring @ NORMAL + DISTANCE, 0, atol=1e-5)
        np.testing.assert_allclose(np.cross(*plane.shape.frame[:, :2].T), NORMAL, atol=1e-6)
        axes = Rotation.from_quat(plane.orientation).as_matrix()
        np.testing.assert_allclose(axes, plane.shape.frame, atol=1e-9)
        assert np.linalg.norm(plane.orientation) == pytest.approx(1)
    # Outlines run counter-clockwise seen from the sensor, and holes the other way round.
    rings = planes[0].hull, *planes[0].holes
    sums = [np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0) for ring in rings]
    outer, hole = sums @ NORMAL / 2
    assert len(rings[0]) == 6 and outer > 0 > hole
    # Along the border of 1060 pixels, of 39000; that of a cloud runs through their middle.
    near = (0.25 if image.camera else 0.5) * 1060 / 39000
    assert outer + hole == pytest.approx(planes[0].area, rel=near)


def test_an_outline_ends_before_the_horizon():
    """At twice the range of the cells of pixels that are farthest."""
    camera = Camera(80, 64, 60.0, 60.0, 39.5, 31.9)
    labels = np.zeros(camera.shape, np.uint16)
    labels[32:] = 1
    image = RangeImage(camera.rays, np.maximum(camera.rays[..., 1], 0).astype(np.float32), camera)
    (plane,) = fit_planes(labels, image, KINECT)
    x, y, z = plane.hull.T
    np.testing.assert_allclose(y, 1, atol=1e-6)
    # Cells are 8 x 8 pixels; rows 32 to 39 are 3.6 below the horizon in the mean.
    assert z.max() == pytest.approx(2 * 60 / 3.6, rel=1e-3)
    assert (np.abs(60 * x / z).round(3) == 40).all() and len(z) == 4


@FORMS
def test_pixels_of_a_neighbour_at_the_border_do_not_turn_the_plane(form):
    image = form(plane_image(error=10 * QUANTUM * boxes((100, 296, 200, 300))))
    (plane,) = fit_planes(boxes((100, 100, 200, 300)), image, KINECT)
    np.testing.assert_allclose(plane.normal, NORMAL, atol=1e-6)
    assert plane.confidence == pytest.approx(0.98, abs=1e-6) and plane.count == 20000


def test_rough_surfaces_inspire_less_confidence():
    noise = np.random.default_rng(1).normal(0, 4 * QUANTUM, CAMERA.shape)
    (plane,) = fit_planes(boxes((100, 100, 300, 300)), plane_image(error=noise), KINECT)
    # Three quarters within 4 deviations of 0.67 quanta each, of a distribution six times as wide.
    assert 0.05 < plane.confidence < 0.25


def test_what_determines_no_plane_is_left_out():
    labels = boxes((100, 100, 101, 300), (200, 200, 220, 220), (300, 300, 320, 320))
    image = plane_image()
    image.inverse[200:220, 200:220] = 0
    assert [plane.label for plane in fit_planes(labels, image, KINECT)] == [3]
    assert fit_planes(np.zeros(CAMERA.shape, np.uint16), image, KINECT) == []
    # A row of a cloud but that through the sensor, which is not what was seen.
    random = np.random.default_rng(0)
    angle = np.linspace(-0.3, 0.3, 25)
    rays = np.stack([np.sin(angle), -0.2 * np.cos(angle), np.cos(angle)], axis=1)
    row = rays * random.normal(4, 0.02, (25, 1)) + random.normal(0, 1e-4, (25, 3))
    assert fit_planes(np.ones((1, 25), np.uint16), cloud_of(row[None]), KINECT) == []


def test_parts_of_one_plane_share_a_surface_and_steps_do_not():
    labels = boxes((100, 100, 200, 200), (100, 300, 200, 400), (100, 210, 200, 290))
    noise = 0.37 * QUANTUM * smooth_field(CAMERA.shape, (2.0, 2.0), np.random.default_rng(2))
    for step, surfaces in ((0, [1, 1, 1]), (0.04, [1, 1, 3])):
        image = plane_image(DISTANCE - step * (labels == 3), noise)
        assert [p.surface for p in fit_planes(labels, image, KINECT)] == surfaces


@FORMS
@pytest.mark.parametrize('seed', range(3))
def test_areas_and_rectangles_are_those_of_the_pixels(seed, form):
    """Of parts that do not touch, with holes and ragged borders; each pixel by itself."""
    draw = np.random.default_rng(seed)
    camera = Camera(156, 120, 500.0, 550.0, 78.0, 60.0)
    theta = np.array([[0.0, 0, 0], [0.1, 0.05, 0.5], [-0.3, 0.4, 0.7], [0.05, -0.2, 0.6]])
    labels = draw.integers(0, 4, (3, 4), np.uint16).repeat(40, 0).repeat(39, 1)
    labels[draw.random(camera.shape) < 0.003] = 0
    inverse = (theta[labels] * camera.rays).sum(axis=2).astype(np.float32)
    image = form(RangeImage(camera.rays, inverse, camera))
    for plane in fit_planes(labels, image, KINECT):
        rays = camera.rays[labels == plane.label].astype(float)
        level = rays @ theta[plane.label]
        sizes = np.linalg.norm(theta[plane.label]) / (camera.fx * camera.fy * level**3)
        assert plane.area == pytest.approx(sizes.sum(), rel=0.01)
        axes = plane.shape.frame
        values, principal = np.linalg.eigh(np.cov((rays / level[:, None]).T, aweights=sizes))
        if values[2] > 1.2 * values[1]:
            assert abs(principal[:, 2] @ axes[:, 0]) > np.cos(np.radians(1))
        # Corners of the pixels of a camera, centres of those of a cloud.
        half = (0.5 / camera.fx, 0.5 / camera.fy, 0) if image.camera else (0, 0, 0)
        signs = [(x, y, 0) for x in (-1, 1) for y in (-1, 1)]
        corners = np.concatenate([rays + np.multiply(sign, half) for sign in signs])
        along = corners / (corners @ theta[plane.label])[:, None] @ axes[:, :2]
        low, high = along.min(axis=0), along.max(axis=0)
        np.testing.assert_allclose(plane.extents, high - low, atol=1e-4)
        np.testing.assert_allclose(plane.centre @ axes[:, :2], (low + high) / 2, atol=1e-4)


def record(rays, inverse, weight, places):
    """What is summed of pixels (29,): moments, rays, points and places."""
    points, upper = rays / inverse[:, None], np.triu_indices(3)
    sums = [*((weight[:, None] * rays).T @ rays)[upper], *(weight * inverse) @ rays]
    sums += [weight @ inverse**2, len(inverse), *weight @ rays, weight @ inverse, weight.sum()]
    sums += [*points.sum(axis=0), *(points.T @ points)[upper]]
    return np.array([*sums, *places.sum(axis=0), *(places**2).sum(axis=0)])


@FORMS
def test_sums_of_regions_are_those_over_their_pixels(form):
    """Without what is four deviations off the plane of the blocks that a region fills."""
    draw = np.random.default_rng(7)
    camera = Camera(72, 60, 90.0, 95.0, 30.0, 33.0, turn=(0.1, 0.5, -0.5, 0.7))
    sensor = SensorModel(0.001, 0, 1.0, 0, 0.0005, 0, 35)
    theta = np.array([[0, 0, 0.4], [0.1, 0.05, 0.5], [-0.1, 0.2, 0.7], [0.05, -0.1, 0.6]])
    theta = theta @ camera.axes.T
    labels = draw.permutation(np.arange(30) % 4).reshape(5, 6).repeat(12, 0).repeat(12, 1)
    inverse = (theta[labels] * camera.rays).sum(axis=2)
    # Half of the third region is off: it is then no plane, or another sensor.
    inverse += draw.normal(0, np.where(labels == 3, 0.05, 0.0005))
    inverse += 0.1 * draw.choice([-1, 0, 1], labels.shape, p=[0.01, 0.98, 0.01])
    labels = (labels * (draw.random(labels.shape) > 0.01)).astype(np.uint16)
    inverse[draw.random(labels.shape) < 0.01] = 0
    image = form(RangeImage(camera.rays, inverse.astype(np.float32), camera))
    sums = sum_regions(labels, image, Blocks.of(image), sensor)
    total, moments = sums.total(), sums.moments(sensor)
    whole = labels.reshape(15, 4, 18, 4).transpose(0, 2, 1, 3).reshape(15, 18, 16)
    whole = (whole == whole[..., :1]).all(axis=2).repeat(4, 0).repeat(4, 1)
    for label in (1, 2, 3):
        mask = (labels == label) & image.valid
        rays, y = image.rays.astype(float), image.inverse.astype(float)
        plane = np.linalg.lstsq(rays[mask & whole], y[mask & whole], rcond=None)[0]
        outlier = mask & ((y - rays @ plane) ** 2 > 16 * (1e-6 + 0.25e-6))
        assert (sums.pixels[label], sums.outliers[label]) == (mask.sum(), outlier.sum())
        assert (2 * outlier.sum() > mask.sum()) == (label == 3)
        kept = mask if label == 3 else mask & ~outlier
        y, w = y[kept], np.full(kept.sum(), 1e6) if image.camera else 1 / y[kept] ** 2
        parts = y, w, np.argwhere(kept)
        expected, scale = (record(r, *parts) for r in (rays[kept], np.abs(rays[kept])))
        # Of whole blocks of a camera, the middle stands for points and places.
        off = np.abs(total[label] - expected) / scale
        assert off[:POINT].max() < 3e-6 and off[POINT:].max() < (4e-4 if image.camera else 1e-6)
        # With the weights of the sensor; cells of clouds have one each.
        ones = y, np.full(kept.sum(), 1e6), parts[2]
        expected, scale = (record(r, *ones)[: COUNT + 1] for r in (rays[kept], np.abs(rays[kept])))
        off = np.abs(moments[label, : COUNT + 1] - expected) / scale
        assert off.max() < (3e-6 if image.camera else 0.03)
        assert moments[label, RATIO] == pytest.approx(0.25 * kept.sum())
        cells = sums.cells[sums.start[label] : sums.start[label + 1]]
        np.testing.assert_allclose(cells.sum(axis=0), total[label], rtol=1e-9, atol=1e-6)
        assert 16 < len(cells) <= 64 and (cells[:, COUNT] > 0).all()
        first, after = np.argwhere(labels == label).min(0), np.argwhere(labels == label).max(0) + 1
        np.testing.assert_array_equal(sums.box[label], [*first, *after])
    # The third region becomes a part of the first, and the second keeps its cells.
    united = sums.united(np.array([0, 1, 2, 1], np.uint16))
    for found, parts in ((united.total(), total), (united.pixels, sums.pixels)):
        np.testing.assert_allclose(found[1:], [parts[1] + parts[3], parts[2]], rtol=1e-9)
    np.testing.assert_array_equal(*(s.cells[s.start[2] : s.start[3]] for s in (united, sums)))
    box, (one, _, other) = united.box[1], sums.box[1:]
    assert [*np.minimum(one, other)[:2], *np.maximum(one, other)[2:]] == box.tolist()
    assert united.start[2] <= 64


def test_a_region_of_bridged_pixels_joins_the_one_beside():
    whole, regions = plane_image(), boxes((100, 100, 200, 300), (200, 100, 203, 300))
    image = replace(whole, inverse=whole.inverse * (regions != 2))
    sums = sum_regions(regions, image, Blocks.of(image), KINECT)
    view = View(image, whole, grid_of(whole), KINECT, 300, image.pixel_area, True)
    united, _, sums = unite_regions(regions, sums, view, 1.2)
    assert (united == (regions > 0)).all() and sums.pixels.tolist() == [0, 20000]


def test_a_plane_by_another_name_is_the_same_plane():
    (plane,) = fit_planes(boxes((100, 100, 200, 300)), plane_image(), KINECT)
    found, told = plane.named(id=7, role='wall'), replace(plane, id=7, role='wall')
    assert type(found) is type(told) and (plane.id, plane.role) == (1, '')
    for field in fields(plane):
        assert getattr(found, field.name) is getattr(told, field.name)


# A region of 16 pixels tells its normal to ten degrees, where normal and distance are no longer
# linear in the errors: a twentieth of a Kinect's.
UNIT = 0.05 * QUANTUM
# With errors of one kind, and of all.
SENSORS = {
    'white': SensorModel(0.45 * UNIT, 0, 1.0, 2, 0, 0, 35),
    'correlated': SensorModel(0.45 * UNIT, 0, 0.0, 2, 0, 0, 35),
    'systematic': SensorModel(0.01 * UNIT, 0, 1.0, 2, 0.5 * UNIT, 0, 35),
    'all': SensorModel(0.45 * UNIT, 0, 0.33, 2, 0.5 * UNIT, 0, 35),
    'laser': SensorModel(0, 2 * UNIT, 0.2, 2, 0, 2 * UNIT, 20),
    'white laser': SensorModel(0, 2 * UNIT, 1.0, 2, 0, 0, 20),
}


PARTS = [(400, 100, 16, 16, 2), (100, 300, 50, 8, 2), (300, 200, 60, 60, 2), (200, 200, 70, 50, 1)]


@pytest.mark.parametrize('kind', SENSORS)
@pytest.mark.parametrize(('x', 'y', 'width', 'height', 'radius'), PARTS)
def test_sums_over_cells_are_those_over_pixels(kind, x, y, width, height, radius):
    """Of an ellipse in a part of a Kinect's image: 1 touches its borders, and 2 fills it."""
    camera, sensor = Camera(width, height, 585.0, 585.0, 319.5 - x, 239.5 - y), SENSORS[kind]
    exact = -(camera.rays.astype(float) @ (NORMAL / DISTANCE))
    mask = np.hypot(*np.ogrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]) < radius
    image = RangeImage(camera.rays, exact.astype(np.float32), camera)
    (plane,) = fit_planes(mask.astype(np.uint16), image, sensor)

    rows, columns = np.nonzero(mask)
    squared = (rows[:, None] - rows) ** 2 + (columns[:, None] - columns) ** 2
    random = random_variance(sensor, exact[mask] ** 2)
    systematic = systematic_variance(sensor, exact[mask] ** 2)
    field = np.exp(-squared / 4 / sensor.correlation**2)
    field = sensor.white * np.eye(len(rows)) + (1 - sensor.white) * field
    errors = np.sqrt(np.outer(random, random)) * field
    field = np.exp(-squared / 4 / sensor.distortion_length**2)
    errors += np.sqrt(np.outer(systematic, systematic)) * field
    weighted = camera.rays[mask].astype(float) / random[:, None]
    inverse = np.linalg.inv(weighted.T @ camera.rays[mask])
    jacobian = plane_jacobians(NORMAL[None], np.array([DISTANCE]))[0]
    spread = jacobian @ inverse @ weighted.T
    truth = spread @ errors @ spread.T
    # In every direction, as a ratio of variances.
    directions = np.linalg.svd(jacobian)[0][:, :3]
    told, true = (directions.T @ c @ directions for c in (plane.covariance, truth))
    ratio = np.linalg.eigvals(np.linalg.solve(told, true))
    # Errors are alike all over a cell, of which a strip of eight pixels has two across: there
    # they are said to turn the plane by more than they do.
    assert ratio.real.min() > 0.85 and ratio.real.max() < (1.15 if height > 8 else 1.8)
    assert np.linalg.matrix_rank(plane.covariance, tol=1e-9 * np.trace(plane.covariance)) <= 3


@pytest.mark.parametrize('rank', [0, 1, 2, 3])
def test_no_variance_becomes_negative_where_a_covariance_is_magnified(rank):
    random = np.random.default_rng(rank)
    root = random.normal(size=(50, 3, rank)) * 10.0 ** random.uniform(-6, 6, (50, 1, rank))
    middle = root @ root.transpose(0, 2, 1)
    outer = random.normal(size=(50, 4, 3)) * 10.0 ** random.uniform(-3, 3, (50, 4, 1))
    found = squares(roots(outer, middle))
    along = outer @ root
    scale = np.linalg.norm(outer, axis=2) * np.linalg.norm(root, axis=(1, 2))[:, None]
    error = np.abs(found - along @ along.transpose(0, 2, 1))
    assert (error <= 1e-12 * scale[:, :, None] * scale[:, None, :]).all()
    assert (np.diagonal(found, axis1=1, axis2=2) >= 0).all()
    np.testing.assert_array_equal(found, found.transpose(0, 2, 1))
