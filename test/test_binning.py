"""Means of squares of pixels, borders of the planes found in them, and shares of the work."""

import numpy as np
import pytest
from clouds import cloud_of

from rangeseg_ros import Camera, Config, RangeImage, Segmenter
from rangeseg_ros.core.by_planes.borders import with_sharp_borders
from rangeseg_ros.core.by_planes.offsets import Offsets
from rangeseg_ros.core.by_planes.plane_energy import CAP, NO_PLANE, Models
from rangeseg_ros.core.sensing.binning import BUDGETS, Bins, bin_side, widening
from rangeseg_ros.core.sensing.blocks import NODE
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.evaluation.label_files import as_truth
from rangeseg_ros.simulation.fields import smooth_field
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
WALL = np.array([0.1, -0.05, 0.5])


def image_of(inverse, camera=CAMERA):
    return RangeImage(camera.rays, inverse.astype(np.float32), camera)


def test_images_of_any_size_have_about_as_many_bins():
    """And fewer where there is less time."""
    sides = {(240, 320): 1, (480, 640): 2, (480, 848): 2, (720, 1280): 3, (1080, 1920): 5}
    steps = {1: 1, 0.9: 2, 0.56: 2, 0.55: 2, 0.54: 4, 0.36: 4, 0.35: 4, 0.34: 4, 0: 4}
    assert BUDGETS == (1, 0.55, 0.35)
    for budget, step in steps.items():
        assert widening(budget) == step
        for shape, side in sides.items():
            assert bin_side(shape, budget) == step * side


@pytest.mark.parametrize('shape', [(9, 10), (7, 13), (1, 1), (2, 1)])
@pytest.mark.parametrize('side', [2, 3])
@pytest.mark.parametrize('cloud', [False, True])
def test_bins_are_means_of_what_was_measured(shape, side, cloud):
    random = np.random.default_rng(sum(shape))
    inverse = random.uniform(0.5, 0.6, shape).astype(np.float32)
    inverse[random.random(shape) < 0.3] = 0
    camera = Camera(shape[1], shape[0], 50.0, 50.0, 3.0, 3.0)
    rays = np.where(inverse[..., None] > 0, camera.rays, 0).astype(np.float32)
    image = RangeImage(rays, inverse) if cloud else RangeImage(camera.rays, inverse, camera)
    bins = Bins.of(image, side)
    assert bins.means.shape == tuple(-(-length // side) for length in shape)
    # Of a surface that no slope bends.
    steps = np.full([-(-length // 4) for length in bins.means.shape], 0.02, np.float32)
    single = bins._replace(area=0.0).of_one_surface(steps)
    for i, j in np.ndindex(bins.means.shape):
        part = np.s_[side * i : side * (i + 1), side * j : side * (j + 1)]
        known = inverse[part][inverse[part] > 0]
        assert bins.means.inverse[i, j] == pytest.approx(known.mean() if len(known) else 0)
        assert bins.spread[i, j] == pytest.approx(np.ptp(known) if len(known) else 0)
        near = np.abs(known - np.sort(known)[len(known) // 2]) <= 0.02 if len(known) else []
        assert single.inverse[i, j] == pytest.approx(known[near].mean() if len(known) else 0)
        # Those of a camera are of the middle of all pixels, were they in the image.
        if not cloud:
            middle = (np.array([j, i]) + 0.5) * side - 0.5
            np.testing.assert_allclose(bins.means.rays[i, j], [*(middle - 3) / 50, 1], atol=1e-6)
        elif len(known):
            own = rays[part][inverse[part] > 0]
            np.testing.assert_allclose(bins.means.rays[i, j], own.mean(axis=0), rtol=1e-5)
            np.testing.assert_allclose(single.rays[i, j], own[near].mean(axis=0), rtol=1e-5)


def test_a_jump_mixes_no_two_surfaces():
    """But in bins of one surface nothing is left out, however steep that is."""
    columns = np.arange(CAMERA.width)
    for edge in (200, 201):
        bins = Bins.of(image_of(np.where(columns < edge, 0.5, 0.25) * np.ones(CAMERA.shape)), 2)
        found = bins.of_one_surface(np.full((60, 80), 0.01, np.float32)).inverse
        assert set(np.unique(found)) == {np.float32(0.5), np.float32(0.25)}
        # Of two that are as large, the nearer one.
        assert (found[:, 100] == (0.5 if edge == 201 else 0.25)).all()
    bins = Bins.of(image_of(np.maximum(CAMERA.rays @ [0.0, 0.7, 0.01], 0)), 2)
    found = bins.of_one_surface(np.full((60, 80), 1e-4, np.float32)).inverse
    near = bins.means.inverse > 0.1  # seen at more than five degrees
    np.testing.assert_array_equal(found[near], bins.means.inverse[near])


@pytest.mark.parametrize(('width', 'side', 'power'), [(0, 2, 0), (0, 3, 2), (3.0, 2, 0)])
def test_noise_of_pixels_follows_from_that_of_bins(width, side, power):
    """White noise of variance 1 leaves means of n pixels 1 / n, correlated noise nearly all."""
    random = np.random.default_rng(3)
    noise = smooth_field(CAMERA.shape, (width, width) if width else None, random)
    level = CAMERA.rays @ WALL
    bins = Bins.of(image_of(level + 0.002 * level**power * noise), side)
    level = bins.means.rays @ WALL
    error = ((bins.means.inverse - level) / level**power).std()
    stated = SensorModel.from_config(Config(noise=0.0, range_noise=0.0))
    stated = stated._replace(**{'range_noise' if power else 'noise': float(error)})
    assert error**2 * bins.noise_of_pixels(stated) == pytest.approx(0.002**2, rel=0.1)


@pytest.mark.parametrize(('correlation', 'white'), [(0.0, 1.0), (2.0, 0.1), (2.0, 0.5)])
def test_the_model_of_bins_is_that_of_their_means(correlation, white):
    random = np.random.default_rng(4)
    smooth = smooth_field(CAMERA.shape, (2.0, 2.0), random) if correlation else 0.0
    noise = np.sqrt(white) * random.normal(0, 1, CAMERA.shape) + np.sqrt(1 - white) * smooth
    means = noise.reshape(240, 2, 320, 2).mean(axis=(1, 3))
    stated = SensorModel.from_config(Config())
    pixels = stated._replace(noise=0.002, white=white, correlation=correlation)
    binned = pixels.binned(2)
    assert binned.noise == pytest.approx(0.002 * means.std(), rel=0.1)
    again = binned.of_pixels(2, (pixels.noise / binned.noise) ** 2)
    assert again.noise == pytest.approx(pixels.noise)
    # What means lose of correlated noise, 6 % here, counts as new as well.
    assert white <= again.white + 1e-9 and again.white < white + 0.06
    assert again.correlation == correlation
    # Noise that hangs together over less than a pixel is new in each.
    narrow = pixels._replace(correlation=0.01, white=0.0).binned(2)
    assert narrow.noise == pytest.approx(pixels.noise / 2)


def neighbours(i, j, shape):
    """Places beside one that are inside an image, in raster order."""
    around = (i - 1, j), (i, j - 1), (i, j + 1), (i + 1, j)
    return [(a, b) for a, b in around if 0 <= a < shape[0] and 0 <= b < shape[1]]


@pytest.mark.parametrize('side', [2, 3])
def test_pixels_beside_borders_take_the_label_of_the_lowest_cost(side):
    """One by one, given their neighbours."""
    draw, camera = np.random.default_rng(side), Camera(21, 17, 20.0, 21.0, 10.0, 8.0)
    bins = -(-17 // side), -(-21 // side)
    coarse = draw.integers(0, 4, (4, 4), np.uint16).repeat(3, 0).repeat(3, 1)
    regions = np.ascontiguousarray(coarse[: bins[0], : bins[1]])
    theta = np.array([[0, 0, 0], [0.1, 0, 0.5], [0, 0.1, 0.52], [-0.1, 0, 0.49]])
    # Offsets of every plane at every block of 2 x 2 bins.
    blocks = -(-bins[0] // NODE), -(-bins[1] // NODE)
    values = draw.normal(0, 0.05, (4, *blocks)).astype(np.float32)
    box, start = np.tile([0, 0, *blocks], (4, 1)), np.arange(4) * blocks[0] * blocks[1]
    models = Models(theta, np.array([0, 0.5, 0.4, 0.3]), Offsets(box, start, values.ravel()))
    truth = draw.integers(1, 4, camera.shape)
    inverse = (theta[truth] * camera.rays).sum(axis=2) + draw.normal(0, 0.01, camera.shape)
    inverse[draw.random(camera.shape) < 0.1] = 0
    image = RangeImage(camera.rays, inverse.astype(np.float32), camera)
    sensor, prior = SensorModel(0.01, 0, 1, 0, 0, 0, 35), 0.9
    expected = regions.repeat(side, 0).repeat(side, 1)[:17, :21] * image.valid
    for i, j in np.ndindex(bins):
        inside = (i, j), *neighbours(i, j, bins)
        names = list(dict.fromkeys(int(regions[at]) for at in inside))[:4]
        for u, v in np.ndindex(side, side) if len(names) > 1 else ():
            u, v = i * side + u, j * side + v
            if u >= 17 or v >= 21 or inverse[u, v] == 0:
                continue
            near = [at for at in neighbours(u, v, camera.shape) if image.valid[at]]
            moved = 1 + np.where(np.equal(names, 0), 0, values[names, i // NODE, j // NODE])
            off = image.inverse[u, v] - moved * (theta[names] @ camera.rays[u, v])
            costs = np.minimum(models.half_precision[names] * off**2 / 1e-4, CAP)
            costs[np.equal(names, 0)] = NO_PLANE
            costs += [prior * sum(expected[at] != name for at in near) for name in names]
            expected[u, v] = names[int(costs.argmin())]
    labels = regions.astype(np.int32)
    found = with_sharp_borders(regions, labels, models, image, side, sensor, prior)
    np.testing.assert_array_equal(found, expected)
    assert (expected != regions.repeat(side, 0).repeat(side, 1)[:17, :21])[image.valid].sum() > 20


def test_borders_are_those_of_pixels():
    """A crease along odd columns and a card along odd rows, neither on a border of bins."""
    rows, columns = np.indices(CAMERA.shape)
    right = WALL + 0.5 * np.array([1, 0, (CAMERA.cx - 300.5) / CAMERA.fx])
    truth = np.where(columns > 300, 1, 2)
    inverse = np.where(columns > 300, CAMERA.rays @ right, CAMERA.rays @ WALL)
    card = (rows >= 101) & (rows < 200) & (columns >= 51) & (columns < 150)
    truth[card], inverse[card] = 3, 1.0
    noise = np.random.default_rng(5).normal(0, 1e-4, CAMERA.shape)
    result = Segmenter().segment(image_of(inverse + noise))
    assert np.count_nonzero(result.labels != truth) < 0.2 * 480, 'a fifth of a pixel along one'
    counts = [plane.count for plane in result.planes]
    assert [0, *counts] == np.bincount(result.labels.flat).tolist()
    # A plane that loses all of its pixels is none.
    left = result.of_pixels(result.labels * np.uint16(result.labels < 3), result.image, None)
    assert [plane.count for plane in left.planes] == counts[:2] and left.normals.any()


@pytest.fixture(scope='module')
def room():
    """What a Kinect sees of a room, and the labels of its faces."""
    camera = kinect_camera(321, 241)
    frame = simulate(kinect_room(2), Kinect(0), camera, seed=2)
    return RangeImage.from_depth(frame.depth, camera), frame.labels


@pytest.mark.parametrize('budget', [*BUDGETS, 0.0])
def test_planes_are_those_of_the_scene(room, budget):
    """Every wall, floor and ceiling of a twelfth of the image is found, its pixels too."""
    image, truth = room
    result = Segmenter(Config(work_budget=budget)).segment(image)
    assert result.labels.shape == result.edges.shape == image.shape
    assert not result.labels[~image.valid].any()
    counts = [np.count_nonzero(result.labels == plane.label) for plane in result.planes]
    assert counts == [plane.count for plane in result.planes]
    overlap = as_truth(truth * image.valid, image.valid.size // 12).compare(result.labels)
    # Of every fourth pixel borders are four pixels wide.
    assert len(overlap.truth) > 3 and overlap.best_iou.min() > (0.85 if budget > 0 else 0.7)


def test_clouds_and_bodies_are_halved(room):
    image, budget = room[0], Config(work_budget=0.7)
    result = Segmenter(budget).segment(cloud_of(image.points))
    assert result.labels.shape == image.shape and result.planes
    body = np.indices(image.shape)[0] >= 150
    hidden = Segmenter(budget).segment(image.without(body))
    assert hidden.planes and not hidden.labels[body].any()


def test_planes_scatter_by_the_noise_of_pixels_and_not_of_bins():
    depth = 2 + np.random.default_rng(0).normal(0, 0.004, CAMERA.shape)
    (plane,) = Segmenter().segment(RangeImage.from_depth(depth, CAMERA)).planes
    assert plane.rms == pytest.approx(0.004, rel=0.03)
