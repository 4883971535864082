"""`rangeseg bench`: time and memory of the stages."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click

from rangeseg_ros.cli import options
from rangeseg_ros.core.config import Config
from rangeseg_ros.evaluation import benchmark
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.files import scratch_folder
from rangeseg_ros.io.images import write_image
from rangeseg_ros.simulation.kinect import simulate_kinect
from rangeseg_ros.simulation.scenes import kinect_room
from rangeseg_ros.simulation.sensors.kinect import kinect_camera

VGA = (640, 480)
SIZES = ((320, 240), VGA, (1280, 720), (1920, 1080))
CACHE = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache') / 'rangeseg_ros'


@click.command()
@click.argument('depth', nargs=-1, type=options.FILE)
@click.option(
    '--camera',
    'camera_file',
    type=options.FILE,
    help='Intrinsics of the DEPTH images: a ROS camera-calibration YAML file.',
)
@options.depth_scale
@options.params
@options.method
@click.option(
    '--scenes',
    type=click.IntRange(min=1),
    default=5,
    show_default=True,
    help='How many simulated rooms, where no DEPTH is given.',
)
@click.option(
    '--rounds',
    type=click.IntRange(min=1),
    default=3,
    show_default=True,
    help='How many times each frame is segmented.',
)
@click.option(
    '--threads',
    type=click.IntRange(min=1),
    help='At most so many, of the four that a frame can use.  [default: one for each core]',
)
@click.option(
    '--exact',
    is_flag=True,
    help='Compare the energy to that of the exact minimisation: slow, but for frames seen before.',
)
@click.option(
    '--cache',
    type=click.Path(file_okay=False, path_type=Path),
    default=CACHE,
    help='Folder for the exact energies.  [default: ~/.cache/rangeseg_ros]',
)
@click.option(
    '--scaling',
    is_flag=True,
    help='Also other sizes of image: ' + ', '.join(f'{w}x{h}' for w, h in SIZES) + '.',
)
@click.option(
    '--budget',
    'budgets',
    type=click.FloatRange(0, 1),
    multiple=True,
    help='Also with this `work_budget`; may be repeated.',
)
@options.json_file
def command(
    depth: tuple[Path, ...],
    camera_file: Path | None,
    depth_scale: float | None,
    params_file: Path | None,
    method: str | None,
    scenes: int,
    rounds: int,
    threads: int | None,
    exact: bool,
    cache: Path,
    scaling: bool,
    budgets: tuple[float, ...],
    json_file: Path | None,
) -> None:
    """Measure the time and memory of each stage on DEPTH images, or on simulated rooms.

    Times are wall-clock times; for figures that mean something, run it on an idle machine.
    """
    if bool(depth) != bool(camera_file):
        raise click.UsageError('DEPTH images and --camera belong together')
    if depth and scaling:
        raise click.UsageError('--scaling is for simulated images, not for DEPTH')
    config = options.read_parameters(params_file, method=method)
    within = {f'{budget:g}': replace(config, work_budget=budget) for budget in budgets}
    progress = partial(options.progress, unit='frame')
    with scratch_folder('rangeseg_bench') as folder:
        if camera_file:
            frames = benchmark.Frames(depth, read_camera(camera_file), depth_scale)
        else:
            frames = _simulated(folder, VGA, scenes)
        figures = benchmark.measure(frames, config, rounds, progress, threads)
        if exact:
            figures['energy_ratio'] = benchmark.energy_ratio(frames, config, cache, progress)
        click.echo(_title(figures))
        click.echo(benchmark.table(figures))
        if scaling:
            figures['scaling'] = _series(folder, figures, config, scenes, rounds, threads)
            click.echo()
            click.echo(benchmark.scaling_table(figures['scaling']))
        if within:
            figures['budgets'] = {
                budget: benchmark.measure(frames, less, rounds, threads=threads)
                for budget, less in within.items()
            }
            click.echo()
            click.echo(benchmark.budget_table(figures['budgets']))
    options.write_json(json_file, figures)


def _title(figures: dict[str, Any]) -> str:
    return (
        f'{figures["frames"]} frames of {figures["width"]}x{figures["height"]}, '
        f'{figures["rounds"]} rounds, method {figures["method"]}, '
        f'threads {figures["threads"]}'
    )


def _series(
    folder: Path,
    vga: dict[str, Any],
    config: Config,
    scenes: int,
    rounds: int,
    threads: int | None,
) -> dict[str, dict[str, Any]]:
    """Figures of all sizes by name, with the `ratio` of their median time to that of VGA."""
    series = {}
    for size in SIZES:
        figures = vga
        if size != VGA:
            frames = _simulated(folder, size, scenes)
            figures = benchmark.measure(frames, config, rounds, threads=threads)
        ratio = figures['total']['median_ms'] / vga['total']['median_ms']
        series[f'{size[0]}x{size[1]}'] = {**figures, 'ratio': ratio}
    return series


def _simulated(folder: Path, size: Sequence[int], scenes: int) -> benchmark.Frames:
    """Depth images of so many rooms, the same in every run."""
    camera = kinect_camera(*size)
    paths = []
    for seed in options.progress(range(scenes), scenes, 'scene'):
        path = folder / f'{size[0]}x{size[1]}_{seed}.png'
        write_image(path, simulate_kinect(kinect_room(seed), camera, seed=seed).depth)
        paths.append(path)
    return benchmark.Frames(tuple(paths), camera)
