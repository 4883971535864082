"""Roles of planes: rooms with known answers, tolerances to the degree, tilted cameras."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from planes_of_labels import painted
from scipy.spatial.transform import Rotation

from rangeseg_ros import Camera, Config, ConfigError
from rangeseg_ros.core.description.tilt import tilt_of
from rangeseg_ros.core.ground.roles import RolesError, ramps_of, roles
from rangeseg_ros.core.sequence import with_roles
from rangeseg_ros.messages.markers import of_ramps

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
LEVEL = Config()
ALL = slice(0, 160)
BOTTOM, TOP = (slice(90, 120), ALL), (slice(0, 25), ALL)
LEFT, RIGHT = (slice(40, 80), slice(0, 75)), (slice(40, 80), slice(80, 160))


def planes(*regions):
    """Planes of ((rows, columns), normal, distance) in the frame of a level camera."""
    return painted(CAMERA, *regions)[1]


def tilted(degrees):
    """Normal that is so many degrees from up."""
    return 0, -np.cos(np.radians(degrees)), -np.sin(np.radians(degrees))


UP, DOWN, AHEAD = tilted(0), tilted(180), tilted(90)


def test_the_floor_is_the_surface_at_the_stated_height():
    """Whatever reaches nearer, or lies lower: a table in front, the landing below a drop."""
    near, far = slice(95, 120), slice(65, 90)
    low, high = ((where, slice(0, 80)) for where in (far, near))
    table, floor = (high, UP, 0.5), (low, UP, 1.2)
    known = Config(sensor_height=1.21)
    assert roles(planes(floor, table), known) == ['floor', 'table']
    assert roles(planes(table, floor), known) == ['table', 'floor']
    for depth in (0.15, 0.5):
        own, landing = (high, UP, 1.2), (low, UP, 1.2 + depth)
        assert roles(planes(own, landing), known) == ['floor', 'lower']
        # Without a height, the surface that reaches nearest.
        assert roles(planes(landing, own), LEVEL) == ['lower', 'floor']
    assert roles(planes(table), known) == ['other']
    (plane,) = planes(table)
    corners = ((plane.corners - plane.centre) @ plane.shape.frame)[:, :2] / (plane.extents / 2)
    assert sorted(corners.round(6).tolist()) == [[-1, -1], [-1, 1], [1, -1], [1, 1]]
    # A table that begins nearer than the floor does, but not as steeply below.
    table, floor = (slice(64, 74), slice(0, 80)), (slice(90, 120), slice(80, 160))
    assert roles(planes((table, UP, 0.05), (floor, UP, 1.2)), LEVEL)[1] == 'floor'


def test_parts_of_the_floor_steps_and_what_lies_beneath_it():
    heights = enumerate((1.11, 1.09, 0.93, 1.29, 1.31))
    scraps = (((slice(100, 106), slice(30 * k, 30 * k + 10)), UP, h) for k, h in heights)
    found = planes(((slice(106, 120), ALL), UP, 1.2), *scraps)
    for surfaces in (range(6), 6 * [1]):
        found = [replace(plane, surface=k) for plane, k in zip(found, surfaces, strict=True)]
        assert roles(found, LEVEL) == ['floor', 'floor', 'step', 'table', 'floor', 'lower']
    assert roles(found, Config(role_height=0.0905))[1:3] == ['floor', 'step']
    assert roles(found, Config(role_height=0.12))[1:3] == ['floor'] * 2


@pytest.mark.parametrize(('degrees', 'role'), [(8, 'ramp'), (-8, 'ramp'), (14, 'other')])
def test_a_ramp_says_how_steep_it_is_and_where_it_climbs(degrees, role):
    """Up ahead, and down ahead, where it climbs towards the robot."""
    angle, normal = np.radians(degrees), np.array(tilted(degrees))
    # The ramp begins 6 m ahead: its plane passes through (0, 1.2, 6).
    where = slice(65 if degrees > 0 else 85, 90), ALL
    ground, ramp = ((slice(97, 120), ALL), UP, 1.2), (where, normal, -normal @ (0, 1.2, 6))
    found = with_roles(planes(ground, ramp), LEVEL)
    assert [plane.role for plane in found] == ['floor', role]
    if role == 'ramp':
        (told,) = ramps_of(found, np.array((0, -1.0, 0)))
        assert told.plane == found[1].id and str(told) == 'ramp 8 degrees'
        assert told.slope == pytest.approx(8, abs=0.01)
        climb = np.sign(degrees) * np.array((0, -np.sin(angle), np.cos(angle)))
        np.testing.assert_allclose(told.climb, climb, atol=1e-4)
        arrow, text = of_ramps([told])
        np.testing.assert_allclose(arrow.points[1] - arrow.points[0], 0.4 * told.climb)
        assert (arrow.namespace, text.namespace, text.text) == ('climbs', 'ramps', str(told))


def test_small_planes_are_no_floor_wall_or_ceiling():
    found = planes(
        ((slice(100, 110), slice(0, 20)), UP, 0.5),
        ((slice(50, 60), slice(0, 20)), AHEAD, 1),
        ((slice(0, 10), slice(0, 20)), DOWN, 0.5),
    )
    assert max(plane.area for plane in found) < 0.1 and roles(found, LEVEL) == ['other'] * 3
    assert roles(found, Config(role_area=0.001)) == ['floor', 'wall', 'ceiling']
    # What hangs from a ceiling is none.
    assert roles(planes((TOP, DOWN, 1), ((slice(0, 8), ALL), AHEAD, 2.5)), LEVEL)[1] == 'wall'


def test_parts_of_one_surface_are_large_together():
    found = planes((LEFT, AHEAD, 1), (RIGHT, AHEAD, 1))
    assert found[0].surface == found[1].surface
    area = sum(plane.area for plane in found)
    assert roles(found, Config(role_area=area - 1e-6)) == ['wall', 'wall']
    assert roles(found, Config(role_area=area + 1e-6)) == ['other', 'other']


@pytest.mark.parametrize(
    ('within', 'beyond', 'where', 'role'),
    [
        (9.9, 10.1, BOTTOM, 'floor'),
        (80.1, 79.9, LEFT, 'wall'),
        (99.9, 100.1, LEFT, 'wall'),
        (170.1, 169.9, TOP, 'ceiling'),
    ],
)
def test_tolerance(within, beyond, where, role):
    for degrees, expected in ((within, role), (beyond, 'other')):
        assert roles(planes((where, tilted(degrees), 1.5)), LEVEL) == [expected]


def test_up_of_any_length_in_the_frame_of_a_tilted_camera():
    tilt = Rotation.from_euler('xyz', [35, 10, -8], degrees=True)
    turned = planes((BOTTOM, tilt.apply(UP), 1.2), (LEFT, tilt.apply(AHEAD), 3))
    up = tilt.apply(UP)
    assert roles(turned, LEVEL) == ['other', 'other']
    assert roles(turned, LEVEL, 9.81 * up) == ['floor', 'wall']
    assert roles(turned, Config(up_x=up[0], up_y=up[1], up_z=up[2])) == ['floor', 'wall']


def test_directions_that_are_none():
    for up in ((0, 0, 0), (np.nan, 0, 1), (0, 1), np.inf, (np.inf, 0, 0)):
        with pytest.raises(RolesError, match='up must be a direction'):
            roles(planes((BOTTOM, UP, 1.2)), LEVEL, up)
    with pytest.raises(ConfigError, match='up_x, up_y, up_z must not all be 0'):
        Config(up_y=0)
    assert roles([], LEVEL) == []


@pytest.mark.parametrize(
    ('degrees', 'change', 'told'),
    [
        (20, {}, True),
        # Up to the slope of a ramp and the tolerance it is none, nor where nothing is built so.
        (12, {}, False),
        (12.1, {}, True),
        (45.1, {}, False),
        (20, {'area': 0.99}, False),
        # Half of what is seen, and twice what agrees with the stated up alone.
        (20, {'askew': 110}, True),
        (20, {'askew': 112}, False),
        (20, {'level': 49}, True),
        (20, {'level': 51}, False),
    ],
)
def test_a_tilt_is_what_most_planes_agree_with(degrees, change, told):
    """100 pixels of a floor, and 10 of a wall that both directions agree with."""
    known = {'area': 1.0, 'level': 0, 'askew': 0} | change
    floor = SimpleNamespace(normal=tilted(degrees), count=100, area=known['area'])
    wall = SimpleNamespace(normal=(1, 0, 0), count=10, area=5.0)
    level = SimpleNamespace(normal=UP, count=known['level'], area=5.0)
    askew = SimpleNamespace(normal=(0.7, -0.5, 0.5), count=known['askew'], area=5.0)
    found = tilt_of([wall, level, floor, askew], np.array(UP), 10.0, 1.0, 12.0)
    assert (found is not None) == told
    if told:
        assert found.degrees == pytest.approx(degrees)
        np.testing.assert_allclose(found.up, tilted(degrees), atol=1e-9)
