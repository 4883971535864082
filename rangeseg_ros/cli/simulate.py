"""`rangeseg simulate`: scenes with known truth, as depth sensors and range scanners see them."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

from rangeseg_ros.cli import options, simulate_terrain
from rangeseg_ros.io.bag_writer import DepthBagWriter
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.io.images import write_image
from rangeseg_ros.segcomp.files import (
    write_angles,
    write_perceptron,
    write_raster,
    write_segmentation,
)
from rangeseg_ros.segcomp.geometry import abw_calibration
from rangeseg_ros.simulation.kinect import NOISES, simulate_kinect
from rangeseg_ros.simulation.render import Frame, simulate
from rangeseg_ros.simulation.scanners import (
    Scan,
    abw_scene,
    perceptron_scene,
    simulate_abw,
    simulate_perceptron,
)
from rangeseg_ros.simulation.scenes import Scene, curved_scene, kinect_room
from rangeseg_ros.simulation.segcomp_truth import ground_truth, region_angles
from rangeseg_ros.simulation.sensors.catalogue import SENSORS
from rangeseg_ros.simulation.sensors.sensor import resize
from rangeseg_ros.simulation.truth import TruePlane

SCENES: dict[str, Callable[[int, int], Scene]] = {'room': kinect_room, 'curved': curved_scene}
_count = click.IntRange(min=1)
_number = partial(click.option, show_default=True)


@click.group()
def command() -> None:
    """Simulate range images with ground truth."""


def set_options(scenes: int, text: str) -> Callable[..., Any]:
    """Options of all sets."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in (
            click.option(
                '--output',
                type=click.Path(path_type=Path),
                required=True,
                help='Folder to make; it must not exist, or be empty.',
            ),
            _number(
                '--seed',
                type=click.IntRange(min=0),
                default=0,
                help='Seed of the first scene; the next ones have the next numbers.',
            ),
            _number('--scenes', type=_count, default=scenes, help=text),
        ):
            command = option(command)
        return command

    return decorate


def room_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options of sets of rooms."""
    for option in (
        click.option('--height', type=click.IntRange(16, 4096), help="Rows; the sensor's own."),
        click.option('--width', type=click.IntRange(16, 4096), help="Columns; the sensor's own."),
        _number(
            '--scene',
            type=click.Choice(list(SCENES)),
            default='room',
            help='Rooms with boxes, or with a ball and a cylinder as well.',
        ),
        _number(
            '--sensor-seed',
            type=click.IntRange(min=0),
            default=0,
            help='Which one of its kind the sensor is: its fixed distortion.',
        ),
        _number(
            '--frames',
            type=_count,
            default=1,
            help='Frames of each scene, at 30 Hz from a camera that moves as if held by hand.',
        ),
        set_options(12, 'How many.'),
    ):
        command = option(command)
    return command


@command.command()
@_number(
    '--sensor',
    type=click.Choice(list(SENSORS)),
    default='kinect',
    help='Structured light, active stereo, time of flight of a phone, lidar of a tablet, or a '
    'sensor without error.',
)
@room_options
def rooms(sensor: str, **given: Any) -> None:
    """Rooms as depth sensors of several kinds see them.

    The files are those of `simulate kinect`. Another width keeps the horizontal field of view.
    """
    _write_rooms(sensor, 'measured', **given)


@command.command()
@_number(
    '--noise',
    type=click.Choice(NOISES),
    default='measured',
    help='As measured on real sensors; the textbook formula, correlated over 1.5 pixels or '
    'independent; or none.',
)
@room_options
def kinect(noise: str, **given: Any) -> None:
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
    _write_rooms('kinect', noise, **given)


def _write_rooms(
    sensor: str,
    noise: str,
    *,
    scenes: int,
    frames: int,
    seed: int,
    sensor_seed: int,
    scene: str,
    width: int | None,
    height: int | None,
    output: Path,
) -> None:
    """Write what a sensor sees in rooms. More than seven parameters: the options of a command."""
    camera = SENSORS[sensor](sensor_seed).camera
    camera = resize(camera, width or camera.width, height or camera.height)

    def see(room: Scene, frame: int, room_seed: int) -> Frame:
        given = {'frame': frame, 'seed': room_seed}
        if sensor == 'kinect':
            return simulate_kinect(room, camera, noise=noise, sensor_seed=sensor_seed, **given)
        return simulate(room, SENSORS[sensor](sensor_seed), camera, **given)

    def seen() -> Iterator[tuple[str, Frame]]:
        for room_seed in range(seed, seed + scenes):
            room = SCENES[scene](room_seed, frames)
            for frame in range(frames):
                name = f'{room_seed:06d}' if frames == 1 else f'{room_seed:06d}_{frame:06d}'
                yield name, see(room, frame, room_seed)

    truth: list[tuple[str, TruePlane]] = []
    count = scenes * frames
    with options.new_folder(output) as folder:
        write_camera(folder / 'camera.yaml', camera)
        with DepthBagWriter(folder / 'bag', camera) as bag:
            for index, (name, image) in enumerate(options.progress(seen(), count, 'image')):
                depth = image.depth
                if depth.dtype != np.uint16:
                    depth = np.rint(1000 * depth).astype(np.uint16)
                write_image(folder / 'depth' / f'{name}.png', depth)
                write_image(folder / 'truth' / f'{name}.png', image.labels)
                truth += [(name, plane) for plane in image.planes]
                bag.write(image.depth, 10**9 + round(index * 1e9 / 30))
        _write_truth(folder, truth)
    click.echo(f'{output}: {count} images')


_segcomp_options = set_options(40, 'How many; 40 as in the real sets, 10 of them for training.')


@command.command()
@_segcomp_options
def abw(scenes: int, seed: int, output: Path) -> None:
    """Polyhedra as the ABW structured-light scanner sees them, in segcomp's files.

    \b
    OUTPUT/abw.SPLIT.N.range    512x512, 8 bits, 0 = shadow
    OUTPUT/abw.SPLIT.N.gt-seg   true regions, from 10; 2 = shadow
    OUTPUT/abw.SPLIT.N.gt-ang   angles between regions that touch
    OUTPUT/planes.csv           plane of each region, metres, optical frame

    SPLIT is train for the first quarter of the scenes (at most 10), and test for the others.
    """

    def write(name: Path, split: str, number: int, scene_seed: int) -> Scan:
        calibration = abw_calibration(number, split)
        scan = simulate_abw(abw_scene(scene_seed), calibration, scene_seed)
        write_raster(f'{name}.range', scan.values)
        return scan

    _write_segcomp_set(output, 'abw', scenes, seed, write)


@command.command()
@_segcomp_options
def perceptron(scenes: int, seed: int, output: Path) -> None:
    """Polyhedra as the Perceptron laser scanner sees them, in segcomp's files.

    \b
    OUTPUT/perc.SPLIT.N          512x512, 12 bits
    OUTPUT/perc.SPLIT.N.gt-seg   true regions, from 10
    OUTPUT/perc.SPLIT.N.gt-ang   angles between regions that touch
    OUTPUT/planes.csv            plane of each region, metres, optical frame

    SPLIT is train for the first quarter of the scenes (at most 10), and test for the others.
    """

    def write(name: Path, split: str, number: int, scene_seed: int) -> Scan:
        scan = simulate_perceptron(perceptron_scene(scene_seed), scene_seed)
        write_perceptron(name, scan.values)
        return scan

    _write_segcomp_set(output, 'perc', scenes, seed, write)


def _write_segcomp_set(
    output: Path,
    sensor: str,
    scenes: int,
    seed: int,
    write: Callable[[Path, str, int, int], Scan],
) -> None:
    """Write images by `write(path, split, number, scene's seed)`, and their ground truth."""
    training = min(scenes // 4, 10)
    truth: list[tuple[str, TruePlane]] = []
    with options.new_folder(output) as folder:
        for index in options.progress(range(scenes), scenes, 'image'):
            split, number = ('train', index) if index < training else ('test', index - training)
            path = folder / f'{sensor}.{split}.{number}'
            image, planes = ground_truth(write(path, split, number, seed + index))
            write_segmentation(f'{path}.gt-seg', image)
            write_angles(f'{path}.gt-ang', region_angles(image, planes))
            truth += [(path.name, plane) for plane in planes]
        _write_truth(folder, truth)
    click.echo(
        f'{output}: {training} training and {scenes - training} test images, '
        f'{len(truth) / scenes:.1f} regions each'
    )


def _write_truth(folder: Path, truth: list[tuple[str, TruePlane]]) -> None:
    """Table of the planes of all images."""
    with (folder / 'planes.csv').open('w', newline='') as file:
        rows = csv.writer(file, lineterminator='\n')
        normal = ('normal_x', 'normal_y', 'normal_z')
        rows.writerow(['image', 'label', 'face', *normal, 'distance', 'count'])
        for image, plane in truth:
            equation = (f'{value:.9g}' for value in (*plane.normal, plane.distance))
            rows.writerow([image, plane.label, plane.face, *equation, plane.count])


command.add_command(simulate_terrain.command)
