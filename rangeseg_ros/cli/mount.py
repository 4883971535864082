"""`rangeseg mount`: how the camera of a recording is mounted above the floor."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import click
import numpy as np

from rangeseg_ros.batch.replay import segment_frames
from rangeseg_ros.cli import options
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.mapping.mount import Mount, mount_of
from rangeseg_ros.core.mapping.placement import Placement
from rangeseg_ros.core.mapping.transforms import Transform
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.io.bags import DepthBag


@click.command()
@click.argument('recording', type=click.Path(path_type=Path))
@click.option('--base', default='base_footprint', show_default=True, help='Frame on the floor.')
@options.config('exact')
@click.pass_context
def command(ctx: click.Context, recording: Path, base: str, config: Config) -> None:
    """Find roll, pitch and height of a camera above the floor.

    The camera stays where it is on its robot, which may drive: of the planes that face up, the
    floor has the largest area times observations. Prints both angles and the height with their
    standard deviations, a static_transform_publisher and the origin of a URDF joint. Yaw and the
    position over the floor are not estimated. If the floor is uncertain, says why; exit code 1.
    """
    # The frame is the camera's own, and its place in that has no error.
    sequence = SequenceSegmenter(replace(config, pose_noise=0.0, pose_turn_noise=0.0))
    still = Placement(pose=Transform.identity())
    frames, name = 0, ''
    with DepthBag(recording) as source:
        for _, frame, _, _ in segment_frames(
            source, sequence, lambda *_: still, partial(options.progress, unit='frame')
        ):
            frames, name = frames + 1, frame.frame_id
    mount = mount_of(sequence.map.planes, frames, sequence.config.role_tolerance)
    if mount is None:
        raise click.ClickException(f'{recording}: no plane that faces up in {frames} frames')
    for line in _lines(mount, base, name):
        click.echo(line)
    for doubt in mount.doubts:
        click.echo(f'rangeseg: the floor is not sure: {doubt}', err=True)
    if mount.doubts:
        ctx.exit(1)


def _lines(mount: Mount, base: str, frame: str) -> list[str]:
    roll, pitch = np.degrees([mount.roll, mount.pitch])
    sigma = np.degrees(mount.sigma[:2])
    x, y, z, w = mount.quaternion
    rpy = ' '.join(f'{angle:.5f}' for angle in mount.rpy)
    return [
        f'roll {roll:.2f} +- {sigma[0]:.2f} degrees',
        f'pitch {pitch:.2f} +- {sigma[1]:.2f} degrees, downwards',
        f'height {mount.height:.3f} +- {mount.sigma[2]:.3f} m',
        'ros2 run tf2_ros static_transform_publisher --x 0 --y 0 '
        f'--z {mount.height:.4f} --qx {x:.6f} --qy {y:.6f} --qz {z:.6f} --qw {w:.6f} '
        f'--frame-id {base} --child-frame-id {frame}',
        f'<origin xyz="0 0 {mount.height:.4f}" rpy="{rpy}"/>',
    ]
