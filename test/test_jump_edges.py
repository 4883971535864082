"""Jump edges of exact scenes: where they are, that they close, shadows, and holes."""

from itertools import product

import cv2
import numpy as np
import pytest
from clouds import cloud_of
from scipy.ndimage import correlate, maximum_filter, minimum_filter

from rangeseg_ros import Camera, RangeImage, Segmenter
from rangeseg_ros.core.sensing import jump_edges
from rangeseg_ros.core.sensing.bridges import bridge_holes
from rangeseg_ros.core.sensing.grid import grid_of
from rangeseg_ros.core.sensing.jump_edges import plane_deviation, sobel

STEP = 0.0044
CAMERA = Camera(120, 100, 100.0, 100.0, 59.5, 49.5)
Y, X = np.indices(CAMERA.shape)


def image_of(inverse):
    return RangeImage(CAMERA.rays, np.asarray(inverse, np.float32), CAMERA)


def ramp(a=0.0, b=0.0, c=0.5):
    """Inverse depth of a plane."""
    return c + a * (X - 60) + b * (Y - 50)


def parts(edges):
    """The 4-connected parts (H, W) that the edges cut the image into, numbered."""
    grid = np.zeros(2 * np.array(CAMERA.shape) - 1, np.uint8)
    grid[::2, ::2] = 1
    grid[::2, 1::2] = ~edges[0]
    grid[1::2, ::2] = ~edges[1]
    return cv2.connectedComponents(grid, connectivity=4)[1][::2, ::2]


def object_of(outline):
    """Where an object is seen (H, W), with corners (x, y) of its outline."""
    return cv2.fillPoly(np.zeros(CAMERA.shape, np.uint8), [np.array(outline)], 1) > 0


CONTINUOUS = [ramp(*slope, c=1.0) for slope in ((0, 0), (0.002, -0.001), (-0.004, 0.003))]
CONTINUOUS += [ramp(0.0007) + h * STEP * (X > 60) for h in (-0.9, 0.9)]
CONTINUOUS += [0.8 + a * 0.004 * np.abs(X - 57.3) for a in (-1, 1)]
# Faces that are steep from pixel to pixel, and may be too narrow for their slope to be told.
STEEP = [np.maximum(place - place.max() + width, 0) for place in (Y, X) for width in (12, 20)]
CONTINUOUS += [1.0 + slope * STEP * face for slope in (10, -10) for face in STEEP]


@pytest.mark.parametrize('inverse', CONTINUOUS)
def test_planes_and_creases_have_no_jump(inverse):
    """Of any slopes, convex or concave; nor have steps that are smaller than a jump."""
    horizontal, vertical = plane_deviation(image_of(inverse), STEP)
    assert not horizontal.any() and not vertical.any()


# What is lower than four steps and twice as steep as the surfaces is no jump.
@pytest.mark.parametrize(('slope', 'jumps'), [(0.0, [69, 70]), (0.041, [69, 70]), (0.042, [70])])
def test_a_line_between_two_jumps_is_parted_from_both(slope, jumps):
    """A pixel wide, a jump on either side: none continues the other, alike as they are."""
    inverse = np.full(CAMERA.shape, 0.5)
    inverse[:, 70] = 0.6
    inverse[:, 71:] = 0.7 + 3 * STEP
    horizontal, _ = plane_deviation(image_of(inverse), STEP, slope)
    assert horizontal[:, jumps].all() and horizontal.sum() == len(jumps) * CAMERA.height


@pytest.mark.parametrize(('height', 'dark'), [(1.1 * STEP, 0), (0.1, 4), (-0.1, 4)])
@pytest.mark.parametrize('slope', [(0, 0), (0.001, 0.001)])
def test_a_jump_lies_exactly_between_its_pixels(height, dark, slope):
    """And continues up to a shadow."""
    inverse = ramp(*slope)
    inverse[:, 70:] += height
    inverse[40:60, 70 - dark : 70 + dark] = 0
    horizontal, vertical = plane_deviation(image_of(inverse), STEP)
    expected = np.zeros_like(horizontal)
    expected[:, 69] = inverse[:, 69] > 0
    np.testing.assert_array_equal(horizontal, expected)
    assert not vertical.any()


@pytest.mark.parametrize(
    'outline',
    [
        [(30, 20), (90, 20), (90, 70), (30, 70)],
        [(30, 20), (95, 35), (80, 80), (20, 60)],
        [(60, 10), (64, 90), (50, 90)],
        [(20, 50), (60, 15), (100, 50), (60, 85)],
    ],
)
def test_contours_of_objects_close(outline):
    """The object is one part, the background another, and nothing else is cut off."""
    front = object_of(outline)
    found = parts(plane_deviation(image_of(ramp(0.0003, 0.0005) + 0.05 * front), STEP))
    assert found.max() == 2
    np.testing.assert_array_equal(found == found[front][0], front)


def test_contours_of_low_steps_close_where_the_mean_is_crossed():
    """Noise hides single steps of ragged outlines: of a hundred links less than one is left."""
    left = count = 0
    for seed in range(6):
        draw = np.random.default_rng(seed)
        front = cv2.GaussianBlur(draw.normal(size=CAMERA.shape), (0, 0), 4) > 0
        noise = draw.normal(0, STEP / 6, front.shape)
        jumps = plane_deviation(image_of(0.5 + 2 * STEP * front + noise), STEP)
        for axis, jump in zip((1, 0), jumps, strict=True):
            outline = np.diff(front, axis=axis)
            left, count = left + np.count_nonzero(outline & ~jump), count + outline.sum()
    assert left < 0.01 * count


# Of a structured-light sensor (thesis 5.5.2, 6.7): where its projector stands aside, an object
# casts a shadow on what is behind, and every contour ends in it. Both surfaces stay apart.
@pytest.mark.parametrize('side', [(0, -1), (0, 1), (-1, 0), (-1, -1)])
@pytest.mark.parametrize('shadow', [0, 1, 4, 14])
@pytest.mark.parametrize(
    ('detector', 'heights'),
    [('sobel', (0.5, 0.055, 0.013, 0.0075)), ('plane', (0.5, 0.026, 2 * STEP, -1.85 * STEP))],
)
def test_no_link_joins_an_object_and_what_is_behind(detector, heights, shadow, side):
    for angle in range(0, 60, 10):
        front = object_of(cv2.boxPoints(((60, 50), (52, 40), angle)).astype(int))
        moved = [np.roll(front, np.multiply(k, side), (0, 1)) for k in range(shadow + 1)]
        dark = np.any(moved, axis=0) & ~front
        for height, slope in product(heights, (0, 0.0009)):
            image = image_of((ramp(slope) + height * front) * ~dark)
            jumps = jump_edges.jump_edges(image, detector, STEP)
            assert image.valid[jump_edges.edge_pixels(jumps)].all()
            found = parts([links == 0 for links in grid_of(image, jumps)])
            both = np.intersect1d(found[front], found[~front & ~dark])
            assert not both.size, (angle, height, slope)


@pytest.mark.parametrize('detect', [lambda i: plane_deviation(i, STEP), sobel])
def test_shadow_alone_makes_no_edge(detect):
    inverse = ramp(0.0003, 0.0002)
    for shadow in (np.s_[20:40, 30:50], np.s_[60, 10:100], np.s_[70:90, 80]):
        inverse[shadow] = 0
    assert not any(map(np.any, detect(image_of(inverse))))


@pytest.mark.parametrize('height', [0.2, -0.2])
def test_sobel_finds_a_thin_line_beside_the_jump(height):
    image = image_of(ramp())
    image.inverse[:, 70:] += height
    horizontal, _ = sobel(image)
    cut = np.flatnonzero(horizontal.any(axis=0)).tolist()
    assert horizontal[:, cut].all()
    assert cut in ([68, 69], [69, 70])  # one column of pixels, 69 or 70
    turned = RangeImage(image.rays.swapaxes(0, 1), image.inverse.T.copy())
    np.testing.assert_array_equal(sobel(turned)[1].T, horizontal)


def test_bridging_joins_neighbours_that_do_not_touch():
    """The example in the documentation of MATLAB's bwmorph(..., 'bridge')."""
    edges = np.array([[1, 0, 0], [1, 0, 1], [0, 0, 1]], bool)
    expected = np.array([[1, 1, 0], [1, 1, 1], [0, 1, 1]], bool)
    np.testing.assert_array_equal(jump_edges.bridge_edges(edges), expected)
    touching = np.eye(7, dtype=bool)
    np.testing.assert_array_equal(jump_edges.bridge_edges(touching), touching)


@pytest.mark.parametrize('shape', [(1, 1), (1, 7), (2, 2), (5, 3)])
def test_small_images(shape):
    image = RangeImage(np.ones((*shape, 3), np.float32), np.ones(shape, np.float32))
    for edges in (plane_deviation(image, STEP), sobel(image)):
        assert [e.shape for e in edges] == [(shape[0], shape[1] - 1), (shape[0] - 1, shape[1])]
        assert not any(map(np.any, edges))


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('slope', [0.004, 0.012])
def test_a_steep_face_whose_directions_err_reaches_the_jump_beside_it(slope, seed):
    """Of blocks that the jump crosses, the wall behind tells the noise of no pixel of the face."""
    random = np.random.default_rng(seed)
    camera = Camera(100, 100, 80.0, 80.0, 49.5, 49.5)
    rows, columns = np.indices(camera.shape)
    face = 2 * columns < rows - 5
    erring = columns + random.normal(0, 0.17, camera.shape)
    inverse = np.where(face, 0.35 - slope * (erring - rows / 2), 0.23)
    inverse += random.normal(0, 1e-4, camera.shape)
    image = RangeImage(camera.rays, inverse.astype(np.float32), camera)
    labels = Segmenter().segment(image).labels
    found = labels == np.bincount(labels[face]).argmax()
    assert (found & face).sum() > 0.996 * (found | face).sum()


VIEW = Camera(160, 120, 146.0, 146.0, 79.5, 59.5)
ROWS, COLUMNS = np.indices(VIEW.shape)
HOLES = {
    'random': np.random.default_rng(0).random(VIEW.shape) < 0.3,
    'every second row': ROWS % 2 == 1,
    'every fourth column': COLUMNS % 4 == 3,
    'chequered': (ROWS + COLUMNS) % 2 == 1,
    'registered 1.1 times larger': (ROWS % 11 == 10) | (COLUMNS % 11 == 10),
    'registered 1.33 times larger': (ROWS % 4 == 3) | (COLUMNS % 4 == 3),
}


@pytest.mark.parametrize('cloud', [False, True])
@pytest.mark.parametrize('holes', HOLES.values(), ids=HOLES)
def test_holes_part_no_plane_and_stay_holes(holes, cloud):
    """Of two walls that meet in the middle."""
    left, right = (VIEW.rays @ np.array([slope, 0, 0.6]) for slope in (0.2, -0.2))
    inverse = np.maximum(left, right) + np.random.default_rng(1).normal(0, 0.001, VIEW.shape)
    depth = np.where(holes, np.nan, 1 / inverse).astype(np.float32)
    seen = cloud_of(depth[..., None] * VIEW.rays) if cloud else RangeImage.from_depth(depth, VIEW)
    result = Segmenter().segment(seen)
    assert len(result.planes) == 2 and not result.labels[holes].any()
    for wall in (left > right, left <= right):
        found = result.labels[wall & ~holes]
        assert np.bincount(found).max() > 0.95 * len(found)


@pytest.mark.parametrize('cloud', [False, True])
def test_a_hole_takes_the_mean_of_what_is_around_it(cloud):
    """Where half of it is measured and goes on."""
    draw, camera = np.random.default_rng(4), Camera(37, 30, 33.0, 34.0, 17.0, 15.0)
    inverse = draw.normal(0.5, 0.01, camera.shape).astype(np.float32)
    inverse *= draw.random(camera.shape) < 0.6
    steps = draw.uniform(0.005, 0.05, (8, 10)).astype(np.float32)
    slopes = draw.uniform(0, 0.005, (8, 10)).astype(np.float32)
    image = RangeImage(camera.rays, inverse, None if cloud else camera)
    whole, seen = bridge_holes(image, steps, slopes), image.valid[..., None]
    values = np.dstack([seen, inverse, camera.rays]) * seen
    count, *sums = np.moveaxis(correlate(values, np.ones((3, 3, 1)), mode='constant'), 2, 0)
    spread = maximum_filter(inverse, 3) - minimum_filter(np.where(inverse, inverse, np.inf), 3)
    apart = spread > np.kron(steps + 2 * slopes, np.ones((4, 4)))[:30, :37]
    few, holes = count < 4, ~image.valid
    bridged = holes & ~few & ~apart
    assert min(part.sum() for part in (holes & few, holes & ~few & apart, bridged)) > 30
    mean, *rays = np.array(sums) / np.maximum(count, 1)
    np.testing.assert_allclose(whole.inverse, np.where(bridged, mean, inverse), rtol=1e-5)
    expected = np.where((bridged & cloud)[..., None], np.dstack(rays), camera.rays)
    np.testing.assert_allclose(whole.rays, expected, rtol=1e-5, atol=1e-6)
    full = RangeImage(camera.rays, np.ones(camera.shape, np.float32))
    assert bridge_holes(full, steps, slopes) is full, 'an image without holes is itself'


def test_pixels_beside_edges_are_those_on_either_side():
    right, below = np.zeros((3, 4), bool), np.zeros((2, 5), bool)
    right[0, 1] = right[2, 3] = below[0, 4] = below[1, 2] = True
    expected = [[0, 1, 1, 0, 1], [0, 0, 1, 0, 1], [0, 0, 1, 1, 1]]
    np.testing.assert_array_equal(jump_edges.edge_pixels((right, below)), expected)
