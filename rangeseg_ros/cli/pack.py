"""`rangeseg pack`: depth images to a recording."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from rangeseg_ros.cli import options
from rangeseg_ros.io.bags import BagError, DepthBagWriter
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.files import natural_order
from rangeseg_ros.io.images import read_depth

SUFFIXES = ('.png', '.tif', '.tiff')


@click.command()
@click.argument('frames_dir', type=options.FOLDER)
@options.camera
@click.option(
    '--output',
    type=click.Path(path_type=Path),
    required=True,
    help='Recording to make: a rosbag2 folder (mcap).',
)
@click.option(
    '--rate',
    type=click.FloatRange(min=0, min_open=True),
    default=30.0,
    show_default=True,
    help='Images per second.',
)
@options.depth_scale
def command(
    frames_dir: Path, camera_file: Path, output: Path, rate: float, depth_scale: float | None
) -> None:
    """Pack the depth images (PNG, TIFF) of FRAMES_DIR into a rosbag2.

    Images are taken in the order of their names, 2 before 10. The topics are /depth/image_rect
    and /depth/camera_info. Images of 16 bits and 0.001 m stay as they are (16UC1), others become
    metres (32FC1).
    """
    paths = sorted(
        (path for path in frames_dir.iterdir() if path.suffix.lower() in SUFFIXES),
        key=natural_order,
    )
    if not paths:
        raise click.ClickException(f'{frames_dir}: no {", ".join(SUFFIXES)} images')
    camera = read_camera(camera_file)
    with DepthBagWriter(output, camera) as bag:
        for index, path in enumerate(options.progress(paths, len(paths), 'image')):
            depth = read_depth(path)
            if depth.dtype != np.uint16:
                depth = np.float32(depth_scale or 1) * depth.astype(np.float32)
            elif depth_scale not in (None, 0.001):
                depth = np.float32(depth_scale) * depth.astype(np.float32)
            try:
                # Time 0 means 'not set' in ROS, so the first image is at one second.
                bag.write(depth, 10**9 + round(index * 1e9 / rate))
            except BagError as error:
                raise click.ClickException(f'{path}: {error}') from None
    click.echo(f'{output}: {len(paths)} images')
