"""`rangeseg simulate`: scenes with known truth, as depth sensors and range scanners see them."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import numpy as np

from rangeseg_ros.cli import options, simulate_terrain
from rangeseg_ros.core.sensing.camera import Camera
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
from rangeseg_ros.simulation.sensors.kinect import kinect_camera
from rangeseg_ros.simulation.sensors.sensor import resize
from rangeseg_ros.simulation.truth import TruePlane

SCENES: dict[str, Callable[[int, int], Scene]] = {'room': kinect_room, 'curved': curved_scene}

seed_option = click.option(
    '--seed',
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help='Seed of the first scene; the next ones have the next numbers.',
)
output_option = click.option(
    '--output',
    type=click.Path(path_type=Path),
    required=True,
    help='Folder to make; it must not exist, or be empty.',
)

sets_option = click.option(
    '--scenes',
    type=click.IntRange(min=1),
    default=40,
    show_default=True,
    help='How many; 40 as in the real sets, 10 of them for training.',
)


@click.group()
def command() -> None:
    """Simulate range images with ground truth."""


scenes_option = click.option(
    '--scenes', type=click.IntRange(min=1), default=12, show_default=True, help='How many.'
)
frames_option = click.option(
    '--frames',
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help='Frames of each scene, at 30 Hz from a camera that moves as if held by hand.',
)
sensor_seed_option = click.option(
    '--sensor-seed',
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help='Which one of its kind the sensor is: its fixed distortion.',
)
scene_option = click.option(
    '--scene',
    'kind',
    type=click.Choice(list(SCENES)),
    default='room',
    show_default=True,
    help='Rooms with boxes, or with a ball and a cylinder as well.',
)


@command.command()
@click.option(
    '--sensor',
    type=click.Choice(list(SENSORS)),
    default='kinect',
    show_default=True,
    help='Structured light, active stereo, time of flight of a phone, lidar of a tablet, or a '
    'sensor without error.',
)
@scenes_option
@frames_option
@seed_option
@sensor_seed_option
@scene_option
@click.option('--width', type=click.IntRange(16, 4096), help="Columns; the sensor's own.")
@click.option('--height', type=click.IntRange(16, 4096), help="Rows; the sensor's own.")
@output_option
def rooms(
    sensor: str,
    scenes: int,
    frames: int,
    seed: int,
    sensor_seed: int,
    kind: str,
    width: int | None,
    height: int | None,
    output: Path,
) -> None:
    """Rooms as depth sensors of several kinds see them.

    The files are those of `simulate kinect`. Another width keeps the horizontal field of view.
    """
    camera = SENSORS[sensor](sensor_seed).camera
    camera = resize(camera, width or camera.width, height or camera.height)

    def see(scene: Scene, frame: int, scene_seed: int) -> Frame:
        if sensor == 'kinect':
            return simulate_kinect(
                scene, camera, frame=frame, sensor_seed=sensor_seed, seed=scene_seed
            )
        return simulate(scene, SENSORS[sensor](sensor_seed), camera, frame=frame, seed=scene_seed)

    _write_rooms(output, camera, range(seed, seed + scenes), frames, SCENES[kind], see)


@command.command()
@scenes_option
@frames_option
@seed_option
@sensor_seed_option
@click.option(
    '--noise',
    type=click.Choice(NOISES),
    default='measured',
    show_default=True,
    help='As measured on real sensors; the textbook formula, correlated over 1.5 pixels or '
    'independent; or none.',
)
@scene_option
@click.option('--width', type=click.IntRange(16, 4096), default=640, show_default=True)
@click.option('--height', type=click.IntRange(16, 4096), default=480, show_default=True)
@output_option
def kinect(
    scenes: int,
    frames: int,
    seed: int,
    sensor_seed: int,
    noise: str,
    kind: str,
    width: int,
    height: int,
    output: Path,
) -> None:
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
    camera = kinect_camera(width, height)

    def see(scene: Scene, frame: int, scene_seed: int) -> Frame:
        return simulate_kinect(
            scene, camera, frame=frame, noise=noise, sensor_seed=sensor_seed, seed=scene_seed
        )

    _write_rooms(output, camera, range(seed, seed + scenes), frames, SCENES[kind], see)


def _write_rooms(
    output: Path,
    camera: Camera,
    seeds: range,
    frames: int,
    build: Callable[[int, int], Scene],
    see: Callable[[Scene, int, int], Frame],
) -> None:
    """Write what `see(scene, frame, seed)` sees in the scenes `build(seed, frames)`."""

    def simulated() -> Iterator[tuple[str, Frame]]:
        for seed in seeds:
            scene = build(seed, frames)
            for frame in range(frames):
                name = f'{seed:06d}' if frames == 1 else f'{seed:06d}_{frame:06d}'
                yield name, see(scene, frame, seed)

    count = len(seeds) * frames
    with options.new_folder(output) as folder:
        write_camera(folder / 'camera.yaml', camera)
        with (
            _TruthTable(folder / 'planes.csv') as table,
            DepthBagWriter(folder / 'bag', camera) as bag,
        ):
            for index, (name, image) in enumerate(options.progress(simulated(), count, 'image')):
                depth = image.depth
                if depth.dtype != np.uint16:
                    depth = np.rint(1000 * depth).astype(np.uint16)
                write_image(folder / 'depth' / f'{name}.png', depth)
                write_image(folder / 'truth' / f'{name}.png', image.labels)
                table.write(name, image.planes)
                bag.write(image.depth, 10**9 + round(index * 1e9 / 30))
    click.echo(f'{output}: {count} images')


@command.command()
@sets_option
@seed_option
@output_option
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
@sets_option
@seed_option
@output_option
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
    regions = 0
    with options.new_folder(output) as folder, _TruthTable(folder / 'planes.csv') as table:
        for index in options.progress(range(scenes), scenes, 'image'):
            split, number = ('train', index) if index < training else ('test', index - training)
            path = folder / f'{sensor}.{split}.{number}'
            image, planes = ground_truth(write(path, split, number, seed + index))
            write_segmentation(f'{path}.gt-seg', image)
            write_angles(f'{path}.gt-ang', region_angles(image, planes))
            table.write(path.name, planes)
            regions += len(planes)
    click.echo(
        f'{output}: {training} training and {scenes - training} test images, '
        f'{regions / scenes:.1f} regions each'
    )


class _TruthTable:
    """CSV of the planes of all images."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> _TruthTable:
        self._file = self.path.open('w', newline='')
        self._rows = csv.writer(self._file, lineterminator='\n')
        normal = ('normal_x', 'normal_y', 'normal_z')
        self._rows.writerow(['image', 'label', 'face', *normal, 'distance', 'count'])
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()

    def write(self, image: str, planes: list[TruePlane]) -> None:
        """Append the planes of an image."""
        for plane in planes:
            equation = (f'{value:.9g}' for value in (*plane.normal, plane.distance))
            self._rows.writerow([image, plane.label, plane.face, *equation, plane.count])


command.add_command(simulate_terrain.command)
