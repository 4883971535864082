"""Every parameter of the segmenter: its default, range and description, in one place."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from rangeseg_ros.core.options import ConfigError, checked, option, unknown_parameter

# Directions of an icosahedron by how often it is subdivided (thesis, table A.3).
DIRECTION_COUNTS = (4, 17, 73, 305, 1249)
VGA = 640 * 480
"""Pixels of the reference image: defaults in pixels scale with the size of the image."""


@dataclass(frozen=True, repr=False)
class Config:
    """Parameters of `Segmenter`; the defaults suit a Kinect-style sensor.

    Raises
    ------
    ConfigError
        A value of the wrong type or outside its range; the message names the parameter and
        its range.
    """

    method: str = option(
        'planes',
        'labels are planes, or discretised normals as in the thesis',
        choices=('planes', 'normals'),
    )
    normals: str = option(
        'cross_product',
        'observed normals: cross product of tangents, or planes fitted in inverse range',
        choices=('cross_product', 'plane_fit'),
    )
    normal_baseline: int = option(
        3, 'pixels from a pixel to the neighbours of its cross product; the thesis uses 1', 1, 50
    )
    normal_radius: int = option(2, 'the window of plane_fit has 2 r + 1 rows and columns', 1, 50)
    direction_count: int = option(
        305,
        'method normals: directions of a subdivided icosahedron, 4, 17, 73, 305 or 1249',
        4,
        1249,
    )
    jump_edges: str = option(
        'plane',
        'edges of regions: deviation from local planes, depth gradient as in the thesis, or none',
        choices=('plane', 'sobel', 'none'),
    )
    edge_step: float = option(0.0, 'smallest jump, 1/m; 0 follows the noise', 0.0, 10.0)
    smoothness: float = option(
        130.0, 'method normals: lambda of eq. 5.3, against degrees; thesis: 55', 0.0, 10000.0
    )
    plane_smoothness: float = option(
        1.2, 'lambda of eq. 5.3 against half the squared residuals, of planes', 0.0, 10000.0
    )
    plane_probability: float = option(
        0.09, 'smallest probability of a plane, no curved surface; 0 = planes of all', 0.0, 1.0
    )
    exact: bool = option(
        False, 'method normals: every label over all of the image until none changes (minutes)'
    )
    work_budget: float = option(
        1.0,
        'method planes: share of the full work; less looks at fewer rows and columns',
        0.0,
        1.0,
    )
    min_pixels: int = option(0, 'smallest plane, pixels; 0 = 300 in VGA', 0, 100000000)
    # Errors of the sensor, by default of a Kinect: noise of 0.45, distortion of half a step of
    # its disparity, of which the quantisation is new in every pixel.
    noise: float = option(0.0013, 'random error of the inverse range, 1/m', 0.0, 10.0)
    range_noise: float = option(0.0, 'random error of the range, metres', 0.0, 10.0)
    pixel_noise: float = option(0.6, "random error of a pixel's direction, pixels", 0.0, 100.0)
    white_noise: float = option(0.33, 'share of the random variance new in every pixel', 0.0, 1.0)
    noise_correlation: float = option(
        2.0, 'width of the Gaussian the noise looks smoothed with, pixels; 0 = white', 0.0, 100.0
    )
    distortion: float = option(0.00145, 'systematic error of the inverse range, 1/m', 0.0, 10.0)
    range_distortion: float = option(0.0, 'systematic error of the range, metres', 0.0, 10.0)
    distortion_length: float = option(
        0.0, 'width of the distortion, pixels, as of the noise; 0 = 35 in VGA', 0.0, 10000.0
    )
    sensor_model: str = option(
        'measured',
        'errors of the sensor: measured in every image as far as it tells, or as given (fixed)',
        choices=('measured', 'fixed'),
    )
    dithering: float = option(
        0.0, 'noise added to the range, metres; breaks up the steps of coarse depth', 0.0, 10.0
    )
    # What is known of one sensor: its fixed distortion, and what always stands in its way.
    distortion_map: str = option(
        '', "file of rangeseg calibrate: the sensor's fixed distortion, which is subtracted"
    )
    mask: str = option(
        '', "PNG, not 0 where images show the robot's own body: neither segmented nor terrain"
    )
    track_time: float = option(3.0, 'seconds out of sight that ids are kept', 0.0, 100000.0)
    up_x: float = option(0.0, 'up in the frame of the image, x', -1000.0, 1000.0)
    up_y: float = option(
        -1.0, 'up in the frame of the image, y; 0, -1, 0: of a level camera', -1000.0, 1000.0
    )
    up_z: float = option(0.0, 'up in the frame of the image, z', -1000.0, 1000.0)
    role_tolerance: float = option(
        10.0, 'largest angle of planes with roles to level or upright, degrees', 0.0, 45.0
    )
    role_height: float = option(
        0.1, 'planes so near to the floor or ceiling belong to it, metres', 0.0, 10.0
    )
    role_area: float = option(0.3, 'smallest floor, ceiling or wall, square metres', 0.0, 1000.0)
    # How the camera moves where planes and tf leave it open: by default like a quick hand.
    camera_turn: float = option(
        60.0, 'standard deviation of the turning of the camera, degrees per second', 0.1, 3600.0
    )
    camera_speed: float = option(
        0.9, 'standard deviation of the speed of the camera, metres per second', 0.001, 100.0
    )
    # The world: frames, the map of planes.
    fixed_frame: str = option(
        '', 'frame in which planes stay put, like map, for ids and a map of planes; empty for none'
    )
    gravity_frame: str = option(
        '', 'frame whose z is up from the ground, like base_footprint: tf tells up and the height'
    )
    target_frame: str = option(
        '', 'frame of ~/planes and ~/markers, like base_link; without a name, that of the images'
    )
    tf_timeout: float = option(0.1, 'seconds that an image waits for its transforms', 0.0, 60.0)
    pose_noise: float = option(
        0.005, 'standard deviation of the place of the camera, metres, for each axis', 0.0, 10.0
    )
    pose_turn_noise: float = option(
        0.3, 'standard deviation of the pose of the camera, degrees, about each axis', 0.0, 45.0
    )
    map_resolution: float = option(0.03, 'smallest detail of outlines of the map, m', 0.001, 10.0)
    map_area: float = option(
        0.05, 'smallest plane of the map, square metres; 0 for clutter as well', 0.0, 1000.0
    )
    map_planes: int = option(1000, 'planes of the map at most, those seen last', 1, 100000)
    odometry: bool = option(
        False, 'own motion from planes and edges: ~/odometry and, without fixed_frame, the map'
    )
    odometry_frame: str = option(
        'odom', "frame of ~/odometry: x forward and z up, at the camera's first place"
    )
    # The ground.
    sensor_height: float = option(
        0.0, 'height of the sensor above the ground, along up, metres; 0 = unknown', 0.0, 100.0
    )
    ground_slope: float = option(12.0, 'steepest slope of the ground, degrees', 0.0, 45.0)
    sensor_height_sd: float = option(
        0.015, 'standard deviation of sensor_height, metres', 0.001, 10.0
    )
    up_sd: float = option(1.5, 'standard deviation of up, degrees', 0.01, 45.0)
    up_drift: float = option(
        2.0, 'turning of up while nothing tells it, degrees per second', 0.0, 360.0
    )
    obstacle_height: float = option(0.05, 'least height of an obstacle, metres', 0.005, 10.0)
    drop_height: float = option(0.05, 'least depth of a drop, metres', 0.005, 10.0)
    ground_gap: float = option(0.15, 'widest gap that the robot crosses, metres', 0.0, 10.0)
    robot_radius: float = option(
        0.25, 'radius of the robot, metres: ground so far apart is connected', 0.01, 10.0
    )
    grid_resolution: float = option(0.05, 'side of a cell of ~/grid, metres', 0.01, 1.0)
    grid_size: float = option(8.0, 'side of ~/grid, metres', 0.1, 50.0)
    grid_memory: float = option(
        30.0, 'seconds that ~/grid remembers, with fixed_frame or odometry', 0.0, 86400.0
    )
    grid_clearance: float = option(2.0, 'headroom of ~/grid, metres', 0.0, 100.0)
    cloud_resolution: float = option(
        0.0, 'side of the cubes that thin the clouds of terrain, metres; 0 = all pixels', 0.0, 1.0
    )
    seed: int = option(0, 'of dithering', 0, 2147483647)

    def __new__(cls, *values: Any, **named: Any) -> Config:
        # The TypeError of the generated __init__ would suggest nothing.
        _check_names(cls, named)
        return super().__new__(cls)

    def __post_init__(self) -> None:
        for option_field in fields(self):
            value = checked(option_field, getattr(self, option_field.name))
            object.__setattr__(self, option_field.name, value)
        if self.direction_count not in DIRECTION_COUNTS:
            counts = ', '.join(map(str, DIRECTION_COUNTS))
            raise ConfigError(
                f'parameter direction_count must be one of {counts}, not {self.direction_count}'
            )
        if self.work_budget < 1 and self.method != 'planes':
            raise ConfigError('parameter work_budget is for method planes')
        if self.odometry and not self.odometry_frame:
            raise ConfigError('parameter odometry_frame must have a name')
        if self.up_x == self.up_y == self.up_z == 0:
            raise ConfigError('parameters up_x, up_y, up_z must not all be 0')

    def __repr__(self) -> str:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        changed = (
            f'{f.name}={values[f.name]!r}' for f in fields(self) if values[f.name] != f.default
        )
        return f'{type(self).__name__}({", ".join(changed)})'

    @property
    def level(self) -> bool:
        """Whether no other up is stated than that of a level camera."""
        return (self.up_x, self.up_y, self.up_z) == (0, -1, 0)

    @property
    def least_step(self) -> float:
        """The least step that is none of the ground, metres."""
        return min(self.obstacle_height, self.drop_height)

    @property
    def steepest(self) -> float:
        """Tangent of the steepest ground."""
        return math.tan(math.radians(self.ground_slope))

    @property
    def map_frame(self) -> str:
        """Frame of the map of planes; empty when there is none."""
        return self.fixed_frame or (self.odometry_frame if self.odometry else '')

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Config:
        """Build a Config from parameter names and values, as read from a YAML file.

        Raises
        ------
        ConfigError
            An unknown name, or a value that the named parameter does not take.

        Warns
        -----
        FutureWarning
            A parameter has another name now; its value is converted.
        """
        if not isinstance(mapping, Mapping):
            raise ConfigError(f'parameters are names and their values, not {mapping!r:.60}')
        mapping = _renamed(mapping)
        _check_names(cls, mapping)
        return cls(**mapping)


def _check_names(kind: type[Config], names: Iterable[object]) -> None:
    known = kind.__dataclass_fields__
    for name in names:
        if name not in known:
            raise ConfigError(unknown_parameter(name, known))


# Former names of parameters, and their names now.
_RENAMED = {'sensor_height_noise': 'sensor_height_sd', 'up_noise': 'up_sd'}
# Former parameters that nothing reads any more; CHANGELOG.rst has the reasons.
_DROPPED = ['directions', 'cycles', 'flatness', 'noise_regions', 'moves', 'refits']
_DROPPED += ['plane_prior', 'track_memory', 'warm_start']

NAMES = frozenset((*_RENAMED, *_DROPPED, *Config.__dataclass_fields__))
"""What parameters are, or were, called."""


def _renamed(mapping: Mapping[str, Any]) -> dict[str, Any]:
    """Names and values of parameters as they are called now."""
    result = {name: value for name, value in mapping.items() if name not in (*_RENAMED, *_DROPPED)}
    said = [f'{name} is not read any more (CHANGELOG.rst)' for name in _DROPPED if name in mapping]
    for former, name in _RENAMED.items():
        if former in mapping:
            result.setdefault(name, mapping[former])
            said.append(f'{former} is called {name} now: {name}: {result[name]!r}')
    for text in said:
        warnings.warn(f'parameter {text}', FutureWarning, stacklevel=3)
    return result
