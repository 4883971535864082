"""Parts of one plane that touch, on exact planes."""

from itertools import pairwise

import numpy as np

from rangeseg_ros.core.fitting.borders import find_borders
from rangeseg_ros.core.fitting.coplanar import group_coplanar
from rangeseg_ros.core.fitting.fits import Fits
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.grid import Grid
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.simulation.sensors.kinect import QUANTUM

KINECT = SensorModel(0.45 * QUANTUM, 0, 0.33, 2, 0.5 * QUANTUM, 0, 35)
CAMERA = Camera(160, 120, 146.0, 146.0, 79.5, 59.5)
WALL, SIDE = np.array([0.0, 0.0, 0.5]), np.array([-0.2, 0.0, 0.5])


def inverse_range(theta):
    return (CAMERA.rays @ theta).astype(np.float32)


def linked():
    return Grid(np.ones((120, 159), np.float32), np.ones((119, 160), np.float32))


def groups(regions, inverse, grid):
    fits = Fits.of(regions, RangeImage(CAMERA.rays, inverse, CAMERA), KINECT)
    borders = find_borders(regions, grid, int(regions.max()) + 1)
    return group_coplanar(fits, borders, KINECT.agreement).tolist()


def stripes(*borders):
    """Regions 1, 2, ... from left to right, each from one border to the next."""
    regions = np.zeros(CAMERA.shape, np.uint16)
    for label, (first, after) in enumerate(pairwise(borders), 1):
        regions[:, first:after] = label
    return regions


def test_parts_of_a_plane_that_touch_are_one():
    regions = stripes(0, 70, 120, 160)
    assert groups(regions, inverse_range(WALL), linked()) == [0, 1, 1, 1]
    assert groups(stripes(0, 40, 160), inverse_range(WALL), linked()) == [0, 2, 2]


def test_what_a_jump_or_a_gap_parts_stays_apart():
    regions, grid = stripes(0, 70, 160), linked()
    grid.right[:, 69] = 0
    assert groups(regions, inverse_range(WALL), grid) == [0, 1, 2]
    grid.right[:40, 69] = 1  # a gap in the jump, or a jump that is none
    step = (inverse_range(WALL) + (regions == 2) * 4 * KINECT.distortion).astype(np.float32)
    assert groups(regions, step, grid) == [0, 1, 2]
    assert groups(regions, inverse_range(WALL), grid) == [0, 2, 2]
    regions[:, 69] = 0
    assert groups(regions, inverse_range(WALL), linked()) == [0, 1, 2]


def test_faces_that_meet_in_a_crease_stay_apart():
    regions = stripes(0, 80, 160)
    inverse = np.where(regions == 1, inverse_range(WALL), inverse_range(SIDE))
    assert groups(regions, inverse, linked()) == [0, 1, 2]


def framed(rows, columns):
    """Region 1 with a region 2 in it."""
    regions = np.ones(CAMERA.shape, np.uint16)
    regions[rows, columns] = 2
    return regions


def test_a_dent_is_a_part_of_the_plane_around_it():
    """Steeper than any crease, but neither before nor behind it."""
    regions = framed(slice(50, 70), slice(60, 80))
    tilt = 0.3 * (CAMERA.rays[..., 0] - CAMERA.rays[60, 70, 0])
    inverse = (inverse_range(WALL) + (regions == 2) * tilt).astype(np.float32)
    assert groups(regions, inverse, linked()) == [0, 1, 1]
    # In a corner of the image, it lies in the wall along half of its outline.
    corner = framed(slice(100, 120), slice(140, 160))
    tilt = 0.3 * (CAMERA.rays[..., 0] - CAMERA.rays[110, 150, 0])
    inverse = (inverse_range(WALL) + (corner == 2) * tilt).astype(np.float32)
    assert groups(corner, inverse, linked()) == [0, 1, 2]


def test_a_picture_on_a_wall_is_none_of_its_dents():
    regions = framed(slice(50, 70), slice(60, 80))
    inverse = (inverse_range(WALL) + (regions == 2) * 8 * KINECT.distortion).astype(np.float32)
    assert groups(regions, inverse, linked()) == [0, 1, 2]


def test_the_foot_of_a_face_is_no_dent():
    """Two planes meet along a line, no more than half of the outline."""
    regions = framed(slice(40, 120), slice(60, 80))
    tilt = (regions == 2) * 0.3 * (CAMERA.rays[..., 0] - CAMERA.rays[60, 70, 0])
    inverse = (inverse_range(WALL) + tilt).astype(np.float32)
    grid = linked()
    grid.right[40:120, 59] = grid.below[39, 60:80] = 0
    assert groups(regions, inverse, grid) == [0, 1, 2]


def test_a_row_of_parts_does_not_bend_a_plane_round():
    """Each agrees with the next, but not the first with the last."""
    regions = stripes(0, 40, 80, 120, 160)
    # Chords of a parabola.
    corners = CAMERA.rays[0, [0, 40, 80, 120, 159], 0]
    bent = np.interp(CAMERA.rays[..., 0], corners, 0.5 + 0.05 * corners**2).astype(np.float32)
    for first in range(1, 4):
        pair = np.isin(regions, (first, first + 1))
        two = np.where(pair, regions - first + 1, 0).astype(np.uint16)
        assert groups(two, np.where(pair, bent, 0), linked()) == [0, 1, 1]
    assert len(set(groups(regions, bent, linked()))) > 2


def test_the_plane_of_united_parts_is_that_of_the_whole():
    regions = stripes(0, 70, 120, 160)
    regions[:40, :40] = 0
    regions[80:, 130:] = 4
    noise = 0.45 * QUANTUM * np.random.default_rng(3).standard_normal(CAMERA.shape)
    inverse = inverse_range(SIDE) + noise.astype(np.float32)
    image = RangeImage(CAMERA.rays, inverse, CAMERA)
    whole = Fits.of((regions > 0).astype(np.uint16), image, KINECT)
    united = Fits.of(regions, image, KINECT).united(np.array([0, 1, 1, 1, 1]), True)
    np.testing.assert_array_equal(united.pixels, whole.pixels)
    np.testing.assert_array_equal(united.boxes(), whole.boxes())
    np.testing.assert_allclose(united.explained, whole.explained, rtol=1e-3, atol=1e-3)
    # The seams are no rims of the whole, and noise does not end there.
    sigma = np.sqrt(np.diag(whole.covariance[1]))
    assert (np.abs(united.theta[1] - whole.theta[1]) < 0.2 * sigma).all()
    np.testing.assert_allclose(np.sqrt(np.diag(united.covariance[1])), sigma, rtol=0.1)
