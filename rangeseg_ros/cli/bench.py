"""`rangeseg bench`: time and memory of the stages."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import click

from rangeseg_ros.cli import options
from rangeseg_ros.core.config import Config
from rangeseg_ros.evaluation import benchmark
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.images import write_image
from rangeseg_ros.simulation.render import simulate
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera


@click.command()
@click.argument('depth', nargs=-1, type=options.FILE)
@options.camera()
@options.depth_scale
@options.config('method')
@options.count('--scenes', default=5, help='How many simulated rooms, where no DEPTH is given.')
@click.option(
    '--size',
    type=(click.IntRange(16, 4096), click.IntRange(16, 4096)),
    default=(640, 480),
    show_default=True,
    metavar='WIDTH HEIGHT',
    help='Of the images of simulated rooms.',
)
@options.count('--rounds', default=3, help='How many times each frame is segmented.')
@options.count('--threads', help='At most so many.  [default: one for each core, up to four]')
@options.json_file
def command(
    depth: tuple[Path, ...],
    camera_file: Path | None,
    depth_scale: float | None,
    config: Config,
    scenes: int,
    size: tuple[int, int],
    rounds: int,
    threads: int | None,
    json_file: Path | None,
) -> None:
    """Measure the time and memory of each stage on DEPTH images, or on simulated rooms.

    Times are wall-clock times; for figures that mean something, run it on an idle machine.
    """
    if bool(depth) != bool(camera_file):
        raise click.UsageError('DEPTH images and --camera belong together')
    with TemporaryDirectory(prefix='rangeseg-') as folder:
        if camera_file:
            frames = benchmark.Frames(depth, read_camera(camera_file), depth_scale)
        else:
            frames = _simulated(Path(folder), size, scenes)
        progress = partial(options.progress, unit='frame')
        figures = benchmark.measure(frames, config, rounds, progress, threads)
    click.echo(
        f'{figures["frames"]} frames of {figures["width"]}x{figures["height"]}, '
        f'{rounds} rounds, method {figures["method"]}, threads {figures["threads"]}'
    )
    click.echo(benchmark.table(figures))
    options.write_json(json_file, figures)


def _simulated(folder: Path, size: tuple[int, int], scenes: int) -> benchmark.Frames:
    """Depth images of so many rooms, the same in every run."""
    camera = kinect_camera(*size)
    paths = []
    for seed in options.progress(range(scenes), scenes, 'scene'):
        paths.append(folder / f'{seed}.png')
        write_image(paths[-1], simulate(kinect_room(seed), Kinect(0), camera, seed=seed).depth)
    return benchmark.Frames(tuple(paths), camera)
