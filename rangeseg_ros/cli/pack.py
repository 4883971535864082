"""`rangeseg pack`: depth images to a recording."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from rangeseg_ros.cli import options
from rangeseg_ros.core.sensing.range_image import NOT_MEASURED
from rangeseg_ros.io.bag_writer import DepthBagWriter
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.depth_files import IMAGES, files_of
from rangeseg_ros.io.files import FileError
from rangeseg_ros.io.images import read_depth
from rangeseg_ros.io.poses import match_poses, read_pose
from rangeseg_ros.io.recordings import BagError


@click.command()
@click.argument('frames_dir', type=options.FOLDER)
@options.camera(required=True)
@options.raw
@options.output_folder('Recording to make: a rosbag2 folder (mcap).')
@options.positive('--rate', 30.0, 'Images per second.', most=1e9)
@options.depth_scale
@click.option(
    '--poses',
    'poses_dir',
    type=options.FOLDER,
    help='Folder of 4x4 matrices, the pose of the camera in the world for each image.',
)
def command(
    frames_dir: Path,
    camera_file: Path,
    raw: bool,
    output: Path,
    rate: float,
    depth_scale: float | None,
    poses_dir: Path | None,
) -> None:
    """Pack the depth images (PNG, TIFF) of FRAMES_DIR into a rosbag2.

    Images are taken in the order of their names, 2 before 10. The topics are /depth/image_rect,
    or /depth/image_raw for raw images whose lens distorts, and /depth/camera_info. Images of 16
    bits and 0.001 m stay as they are (16UC1), others become metres (32FC1).

    A pose is a text file of 16 numbers, row by row: p_world = T p_camera, metres. That of an image
    is <stem>.txt or <stem>.pose.txt, or else the one with the same number in its name. Poses
    become /tf, from the frame world to camera_depth_optical_frame, at the stamps of the images;
    an image whose pose is missing, not finite or not rigid has none.
    """
    paths = files_of(frames_dir)
    if not paths:
        raise click.ClickException(f'{frames_dir}: no {", ".join(IMAGES)} images')
    if (len(paths) - 1) / rate > 2**31 - 2:
        raise click.UsageError(f'--rate {rate:g} leads to stamps beyond the range of ROS')
    camera = read_camera(camera_file, raw)
    poses = match_poses(paths, poses_dir) if poses_dir else {}
    without: list[str] = []
    with DepthBagWriter(output, camera) as bag:
        for index, path in enumerate(options.progress(paths, len(paths), 'image')):
            depth = read_depth(path, camera.shape)
            if depth.dtype.kind == 'f':
                depth = np.float32(depth_scale or 1) * depth.astype(np.float32)
            elif depth.dtype != np.uint16 or depth_scale not in (None, 0.001):
                metres = np.float32(depth_scale or 0.001) * depth.astype(np.float32)
                depth = np.where(depth == NOT_MEASURED, np.float32(np.nan), metres)
            # Time 0 means 'not set' in ROS, so the first image is at one second.
            stamp = 10**9 + round(index * 1e9 / rate)
            try:
                bag.write(depth, stamp)
            except BagError as error:
                raise click.ClickException(f'{path}: {error}') from None
            if poses_dir:
                try:
                    if path not in poses:
                        raise FileError(f'no pose for {path.name}')
                    bag.write_pose(read_pose(poses[path]), stamp)
                except FileError as error:
                    without.append(str(error))
    click.echo(f'{output}: {len(paths)} images')
    if poses_dir:
        more = f', and {len(without) - 1} more' if len(without) > 1 else ''
        why = f', {len(without)} without: {without[0]}{more}' if without else ''
        click.echo(f'{len(paths) - len(without)} poses{why}')
