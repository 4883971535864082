"""`rangeseg simulate terrain`: ground and what interrupts it, as depth sensors see it."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from rangeseg_ros.cli import options
from rangeseg_ros.evaluation.terrain import TerrainTable
from rangeseg_ros.io.cameras import write_camera
from rangeseg_ros.io.images import write_image
from rangeseg_ros.simulation.sensors.catalogue import SENSORS
from rangeseg_ros.simulation.sensors.sensor import resize
from rangeseg_ros.simulation.terrain.frame import simulate_terrain
from rangeseg_ros.simulation.terrain.hard import HARD
from rangeseg_ros.simulation.terrain.kinds import KINDS, stated, terrain_scene


@click.command('terrain')
@click.option(
    '--sensor', type=click.Choice(list(SENSORS)), default='kinect', show_default=True, help='Kind.'
)
@click.option(
    '--scenes',
    type=click.IntRange(min=1),
    default=len(KINDS),
    show_default=True,
    help='How many; the kinds take turns.',
)
@click.option(
    '--seed', type=click.IntRange(min=0), default=0, show_default=True, help='Of the first scene.'
)
@click.option('--kind', type=click.Choice([*KINDS, *HARD]), help='Only scenes of this kind.')
@click.option('--hard', is_flag=True, help='Scenes that are easily confused, of all such kinds.')
@click.option('--width', type=click.IntRange(16, 4096), help="Columns; the sensor's own.")
@click.option('--height', 'rows', type=click.IntRange(16, 4096), help="Rows; the sensor's own.")
@click.option(
    '--output',
    type=click.Path(path_type=Path),
    required=True,
    help='Folder to make; it must not exist, or be empty.',
)
def command(
    sensor: str,
    scenes: int,
    seed: int,
    kind: str | None,
    hard: bool,
    width: int | None,
    rows: int | None,
    output: Path,
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
    camera = SENSORS[sensor](seed).camera
    camera = resize(camera, width or camera.width, rows or camera.height)
    with (
        options.new_folder(output) as folder,
        TerrainTable(folder / 'terrain.csv') as table,
    ):
        write_camera(folder / 'camera.yaml', camera)
        for number in options.progress(range(seed, seed + scenes), scenes, 'image'):
            scene = terrain_scene(names[number % len(names)], number)
            frame = simulate_terrain(scene, SENSORS[sensor](number), camera, seed=number)
            depth = frame.depth
            if depth.dtype != np.uint16:
                depth = np.rint(1000 * depth).astype(np.uint16)
            name = f'{number:06d}'
            write_image(folder / 'depth' / f'{name}.png', depth)
            write_image(folder / 'truth' / f'{name}.png', frame.terrain)
            for part in ('height', 'size', 'crossing'):
                write_image(folder / part / f'{name}.tiff', getattr(frame, part))
            up, height = stated(scene, number)
            table.write(name, scene.kind, sensor, up, height, scene.stairs)
    click.echo(f'{output}: {scenes} images')
