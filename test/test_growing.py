"""Surfaces grown from the blocks of simple images, and the contacts of parts while they join."""

import numpy as np
import pytest

from rangeseg_ros import Camera, Config, RangeImage
from rangeseg_ros.core.by_planes.patches import Nodes, find_patches
from rangeseg_ros.core.by_planes.region_graph import absorb, find_contacts
from rangeseg_ros.core.by_planes.surfaces import join_surfaces
from rangeseg_ros.core.sensing.grid import View, grid_of
from rangeseg_ros.core.sensing.jump_edges import plane_deviation
from rangeseg_ros.core.sensing.moments import fit_all
from rangeseg_ros.core.sensing.sensor import SensorModel

CAMERA = Camera(160, 120, 146.0, 146.0, 79.5, 59.5)
ROWS, COLUMNS = np.indices(CAMERA.shape)
QUANTUM = 0.0029
"""Of the disparity of a Kinect, 1/m."""
NOISE = 0.45 * QUANTUM
SMOOTHNESS = Config().plane_smoothness
WALL = np.array([0.05, 0.02, 0.5])


def plane(theta):
    return CAMERA.rays @ np.asarray(theta)


def grown(inverse, noise=NOISE, seed=0, least=1, **sensor):
    """Surfaces of the blocks of an image with white noise, and their moments."""
    inverse = inverse + np.random.default_rng(seed).normal(0, noise, inverse.shape)
    image = RangeImage(CAMERA.rays, inverse.astype(np.float32), CAMERA)
    edges = grid_of(image, plane_deviation(image, 0.0065))
    model = SensorModel.from_config(Config(pixel_noise=0.0, **sensor))
    view = View(image, image, edges, model, least, image.pixel_area, True)
    nodes = Nodes.of(view)
    return join_surfaces(*find_patches(nodes, model), nodes, view, SMOOTHNESS)


def covered(labels):
    """Share of some blocks that have a surface; all must have the same.

    Single ones are left over where the patches around have grown to their full size.
    """
    assert np.isin(labels, [0, labels.max()]).all()
    return (labels > 0).mean()


@pytest.mark.parametrize('noise', [0.0, NOISE])
def test_a_plane_is_one_surface(noise):
    labels, moments = grown(plane(WALL), noise)
    assert labels.shape == (60, 80) and covered(labels) > 0.95
    assert moments.shape == (2, 13) and not moments[0].any()
    np.testing.assert_allclose(fit_all(moments)[0][1], WALL, atol=3e-4)


@pytest.mark.parametrize(
    ('change', 'axis', 'near'),
    [((turn, 0, 0), 1, 4) for turn in (0.4, -0.4, 0.15)]
    + [((0, 0, step), 0, 2) for step in (5 * QUANTUM, 0.1)],
)
def test_planes_beside_each_other_are_two_surfaces(change, axis, near):
    """At a crease, where nothing but the slopes tells them apart, and at a step."""
    first = np.indices(CAMERA.shape)[axis] < CAMERA.shape[axis] // 2
    labels, moments = grown(np.where(first, plane(WALL), plane(WALL + change)))
    assert len(moments) == 3
    one, other = np.split(np.moveaxis(labels, axis, 0), 2)
    assert covered(one[:-near]) > 0.9 and covered(other[near:]) > 0.9
    planes = fit_all(moments)[0][[one.max(), other.max()]]
    np.testing.assert_allclose(planes, [WALL, WALL + change], atol=3e-3)


def test_parts_that_do_not_touch_are_surfaces_of_their_own():
    """A pillar hides a stripe of one wall."""
    pillar = (COLUMNS >= 70) & (COLUMNS < 90)
    labels, moments = grown(np.where(pillar, plane([0, 0, 1.0]), plane(WALL)))
    left, front, right = labels[30, [0, 40, 79]]
    assert len({left, front, right, 0}) == 4 and len(moments) == 4


def test_surfaces_below_the_least_are_left_out():
    card = (np.abs(COLUMNS - 80) < 10) & (np.abs(ROWS - 60) < 10)
    inverse = np.where(card, plane([0, 0, 1.0]), plane(WALL))
    assert len(grown(inverse)[1]) == 3
    labels, moments = grown(inverse, least=401)
    assert len(moments) == 2 and not labels[30, 40]


@pytest.mark.parametrize(('strength', 'stated'), [(1, 1), (4, 4), (4, 0)])
def test_distortion_that_the_sensor_has_does_not_split_a_wall(strength, stated):
    """Smooth, at strength 1 twice that of a Kinect. The last case: the others can fail."""
    waves = np.sin(COLUMNS / 26) * np.cos(ROWS / 45) + np.sin(ROWS / 30 + 1)
    bent = plane(WALL) + 0.7 * strength * QUANTUM * waves
    labels, moments = grown(bent, distortion=stated * Config().distortion)
    assert (len(moments) == 2 and covered(labels) > 0.95) if stated else len(moments) > 4


@pytest.mark.parametrize(
    ('power', 'share', 'planes'), [(2, 0.004, 1), (2, 0.03, 0), (1, 0.005, 2)]
)
def test_planes_bend_by_a_share_of_their_width(power, share, planes):
    """A table bends by parts of a thousand, a barrel by more: nowhere as at a crease."""
    across = np.abs(CAMERA.rays[..., 0]) ** power
    bent = across / across.std() * share * 2 * np.ptp(CAMERA.rays[..., 0])  # at 2 m
    labels, moments = grown(1 / (2 + bent), noise=NOISE / 4, distortion=0.0, noise_correlation=0.0)
    assert len(moments) == 1 + planes if planes else len(moments) > 3
    assert planes != 1 or covered(labels) > 0.9


def test_clutter_is_no_surface():
    clutter = (ROWS >= 40) & (ROWS < 80)
    random = np.random.default_rng(5)
    inverse = plane(WALL) + clutter * random.normal(0, 20 * QUANTUM, CAMERA.shape)
    labels, _ = grown(inverse, least=100)
    assert not labels[22:38].any()
    assert (labels[:18] > 0).mean() > 0.9 and (labels[42:] > 0).mean() > 0.9


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize(('fold', 'faces'), [(0, 1), (8 * NOISE, 4)])
def test_strong_noise_leaves_no_face_in_parts(fold, faces, seed):
    """Nor does it hide the folds of a wall, every 40 pixels, of nine degrees."""
    inverse = plane(WALL) + fold * np.abs(COLUMNS % 80 - 40) / 40
    labels, _ = grown(inverse, NOISE, seed, 300, distortion=0.0, noise_correlation=0.0)
    assert labels.max() == faces


def borders(part, right, below, count):
    """Length of the border between every two parts, by definition."""
    found = np.zeros((count, count))
    for one, other, touch in ((part[:, :-1], part[:, 1:], right), (part[:-1], part[1:], below)):
        touch = touch & (one != other) & (one > 0) & (other > 0)
        np.add.at(found, (one[touch], other[touch]), 1)
    return found + found.T


def as_matrix(contacts, values):
    """Values (2E,) of the half-edges from part to part, as chains lead to them; 0 for none."""
    told = np.zeros((len(contacts.head), len(contacts.head)))
    for a, h in enumerate(contacts.head):
        while h >= 0:
            if contacts.length[h // 2] > 0:
                assert told[a, contacts.target[h]] == 0
                told[a, contacts.target[h]] = values[h]
            h = contacts.link[h]
    return told


@pytest.mark.parametrize('seed', range(4))
def test_contacts_stay_those_of_the_grid(seed):
    rng = np.random.default_rng(seed)
    shape, count = (14, 17), 25
    part = rng.integers(0, count, (7, 9), np.int32).repeat(2, 0).repeat(2, 1)[:, : shape[1]]
    right = rng.random((shape[0], shape[1] - 1)) < 0.8
    below = rng.random((shape[0] - 1, shape[1])) < 0.8
    contacts = find_contacts(part, right, below, count)
    strips = rng.random((len(contacts.target), 2))
    told, apart = [as_matrix(contacts, strips[:, k]) for k in range(2)], contacts.length.copy()
    merged = np.eye(count)
    for _ in range(15):
        found = borders(part, right, below, count)
        assert np.array_equal(as_matrix(contacts, contacts.length.repeat(2)), found)
        for k in range(2):
            expected = merged @ told[k] @ merged.T * (found > 0)
            assert np.allclose(as_matrix(contacts, strips[:, k]), expected)
        a, b = (int(k) for k in rng.choice(np.argwhere(found > 0)))
        part[part == b] = a
        merged[a], merged[b] = merged[a] + merged[b], 0
        absorb(contacts, strips, apart, a, b)
        assert np.array_equal(np.isinf(apart), contacts.length == 0)
