"""`rangeseg simulate`: scenes with known truth, as depth sensors see them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.cli import options
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.evaluation.terrain import write_terrains
from rangeseg_ros.io.bag_writer import DepthBagWriter
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.io.images import write_image
from rangeseg_ros.io.tables import write_table
from rangeseg_ros.simulation.render import Frame, TruePlane, simulate
from rangeseg_ros.simulation.scenes import Scene, curved_scene, kinect_room
from rangeseg_ros.simulation.sensors.catalogue import SENSORS
from rangeseg_ros.simulation.sensors.kinect import NOISES, Kinect
from rangeseg_ros.simulation.sensors.sensor import Sensor, resize
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.kinds import HARD, KINDS, stated, terrain_scene
from rangeseg_ros.simulation.terrain.scene import Terrain
from rangeseg_ros.simulation.terrain.testpieces import catalogue, piece_scene

_PLANES = 'image', 'label', 'face', 'normal_x', 'normal_y', 'normal_z', 'distance', 'count'
SCENES: dict[str, Callable[[int, int], Scene]] = {'room': kinect_room, 'curved': curved_scene}
_size = click.IntRange(16, 4096)

_sensor = options.choice(
    '--sensor',
    list(SENSORS),
    'Structured light, active stereo, time of flight of a phone, lidar of a tablet, or a sensor '
    'without error.',
)
_common_options = options.together(
    options.number('--seed', default=0, help='Of the first scene; each further one adds 1.'),
    click.option('--width', type=_size, help="Columns; the sensor's own."),
    click.option('--height', type=_size, help="Rows; the sensor's own."),
    options.output_folder('Folder to make; it must not exist, or be empty.'),
)
_of_rooms = options.together(
    options.choice('--scene', list(SCENES), 'Boxes alone, or with a ball and a cylinder.'),
    options.number('--sensor-seed', default=0, help='Which one of its kind the sensor is.'),
    options.count('--scenes', default=12, help='How many.'),
    options.count('--frames', default=1, help='Of each scene, at 30 Hz from a hand that moves.'),
    _common_options,
)


@click.group()
def command() -> None:
    """Simulate range images with ground truth."""


@command.command()
@_sensor
@_of_rooms
def rooms(sensor: str, sensor_seed: int, **given: Any) -> None:
    """Rooms as depth sensors of several kinds see them.

    The files are those of `simulate kinect`. Another width keeps the horizontal field of view.
    """
    _write_rooms(SENSORS[sensor](sensor_seed), **given)


@command.command()
@options.choice(
    '--noise',
    NOISES,
    'As measured on real sensors; the textbook formula, correlated over 1.5 pixels or '
    'independent; or none.',
)
@_of_rooms
def kinect(noise: str, sensor_seed: int, **given: Any) -> None:
    """Rooms as a Kinect sees them, with a choice of its noise.

    \b
    OUTPUT/depth/NAME.png   depth, 16 bits, millimetres, 0 = no measurement
    OUTPUT/truth/NAME.png   true regions, 16 bits: 0 = no measurement,
                            65535 = not planar, else a label
    OUTPUT/planes.csv       plane of each region: normal . p + distance = 0,
                            metres, optical frame; regions of the same face
                            of a scene's solids share the number face
    OUTPUT/camera.yaml      intrinsics
    OUTPUT/bag              all depth images, as a rosbag2 (mcap) at 30 Hz

    NAME is the scene's seed, and the number of the frame where there are several. Without noise
    the images are rounded to millimetres; the bag then holds exact metres (32FC1).
    """
    _write_rooms(Kinect(sensor_seed, noise), **given)


def _write_rooms(
    sensor: Sensor,
    *,
    scenes: int,
    frames: int,
    seed: int,
    scene: str,
    width: int | None,
    height: int | None,
    output: Path,
) -> None:
    """Write what a sensor sees in rooms. More than seven parameters: the options of a command."""
    camera = _camera(sensor, width, height)

    def seen() -> Iterator[tuple[str, Frame]]:
        for number in range(seed, seed + scenes):
            room = SCENES[scene](number, frames)
            for frame in range(frames):
                name = f'{number:06d}' if frames == 1 else f'{number:06d}_{frame:06d}'
                yield name, simulate(room, sensor, camera, frame=frame, seed=number)

    truth: list[tuple[str, TruePlane]] = []
    count = scenes * frames
    with options.new_folder(output) as folder:
        write_camera(folder / 'camera.yaml', camera)
        with DepthBagWriter(folder / 'bag', camera) as bag:
            for index, (name, image) in enumerate(options.progress(seen(), count, 'image')):
                _write_depth(folder, name, image.depth, image.labels)
                truth += [(name, plane) for plane in image.planes]
                bag.write(image.depth, 10**9 + round(index * 1e9 / 30))
        rows = [
            [name, plane.label, plane.face, *plane.normal, plane.distance, plane.count]
            for name, plane in truth
        ]
        write_table(folder / 'planes.csv', _PLANES, rows)
    click.echo(f'{output}: {count} images')


@command.command()
@_sensor
@click.option('--kind', type=click.Choice([*KINDS, *HARD]), help='Only scenes of this kind.')
@click.option('--hard', is_flag=True, help='Scenes that are easily confused, of all such kinds.')
@options.count('--scenes', default=len(KINDS), help='How many; the kinds take turns.')
@_common_options
def terrain(
    sensor: str, kind: str | None, hard: bool, scenes: int, seed: int, **given: Any
) -> None:
    """Ground, drops, stairs, ramps, curbs, mirrors and obstacles, from a robot.

    \b
    OUTPUT/depth/NAME.png      depth, 16 bits, millimetres, 0 = no measurement
    OUTPUT/truth/NAME.png      0 not judged, 1 ground, 2 obstacle, 3 drop
    OUTPUT/height/NAME.tiff    metres above the ground below the point
    OUTPUT/size/NAME.tiff      height of the whole object, depth of the drop, m
    OUTPUT/crossing/NAME.tiff  depth at which the ray crosses the ground, m
    OUTPUT/terrain.csv         of each image: kind, up and sensor_height as the
                               robot knows them (off by 1 degree per axis and
                               1 cm), stairs
    OUTPUT/camera.yaml         intrinsics

    The camera is 0.3 to 1.6 m high, and looks down by 0 to 60 degrees. Another width keeps the
    horizontal field of view. `rangeseg evaluate OUTPUT` compares classes of pixels with the truth.
    """
    names = [kind] if kind else list(HARD if hard else KINDS)
    numbers = range(seed, seed + scenes)
    made = [terrain_scene(names[number % len(names)], number) for number in numbers]
    _write_terrains(made, sensor, seed, **given)


@command.command()
@_sensor
@options.count('--scenes', default=10, help='Of each piece.')
@click.option(
    '--mount',
    type=click.FloatRange(0.1, 3.0),
    default=0.5,
    show_default=True,
    help='Height of the camera above the ground, metres; it is aimed 1.5 m ahead.',
)
@_common_options
def testpieces(sensor: str, scenes: int, mount: float, seed: int, **given: Any) -> None:
    """Cylinders, boxes, kerbs, edges, gaps and ramps of known size at known distances.

    OUTPUT is as that of `simulate terrain`; `rangeseg evaluate OUTPUT` says which of the pieces
    are detected.
    """
    numbers = range(seed, seed + scenes)
    made = [piece_scene(*piece, mount, number) for piece in catalogue() for number in numbers]
    _write_terrains(made, sensor, seed, **given)


def _write_terrains(
    scenes: Sequence[Terrain],
    sensor: str,
    seed: int,
    width: int | None,
    height: int | None,
    output: Path,
) -> None:
    """Write scenes with numbers from `seed` on, as images of so many columns and rows."""
    camera = _camera(SENSORS[sensor](seed), width, height)
    table = []
    with options.new_folder(output) as folder:
        write_camera(folder / 'camera.yaml', camera)
        for number, scene in options.progress(enumerate(scenes, seed), len(scenes), 'image'):
            frame = simulate_terrain(scene, SENSORS[sensor](number), camera, seed=number)
            name = f'{number:06d}'
            _write_depth(folder, name, frame.depth, frame.terrain)
            for part in ('height', 'size', 'crossing'):
                write_image(folder / part / f'{name}.tiff', getattr(frame, part))
            table.append((name, sensor, scene, stated(scene, number)))
        write_terrains(folder / 'terrain.csv', table)
    click.echo(f'{output}: {len(scenes)} images')


def _camera(sensor: Sensor, width: int | None, height: int | None) -> Camera:
    """Camera of a sensor, for images of another size where one is given."""
    camera = sensor.camera
    return resize(camera, width or camera.width, height or camera.height)


def _write_depth(folder: Path, name: str, depth: NDArray, truth: NDArray) -> None:
    """Write a depth image, of metres as millimetres, and its truth."""
    if depth.dtype != np.uint16:
        depth = np.rint(1000 * depth).astype(np.uint16)
    write_image(folder / 'depth' / f'{name}.png', depth)
    write_image(folder / 'truth' / f'{name}.png', truth)
