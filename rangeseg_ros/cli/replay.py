"""`rangeseg replay`: recordings to labels and planes."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import click

from rangeseg_ros.cli import options
from rangeseg_ros.cli.results import make_segmenter, write_pictures
from rangeseg_ros.core.range_image import RangeImage
from rangeseg_ros.io.bags import DamagedBagError, DepthBag
from rangeseg_ros.io.planes import PlaneTable


@click.command()
@click.argument('bags', metavar='BAG...', nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    '--output',
    type=click.Path(file_okay=False, path_type=Path),
    required=True,
    help='Folder for the results; made when missing.',
)
@click.option('--depth-topic', help='Depth images.  [default: found by type and name]')
@click.option('--camera-topic', help='Intrinsics.  [default: camera_info beside the images]')
@options.params
@options.exact
@click.pass_context
def command(
    ctx: click.Context,
    bags: tuple[Path, ...],
    output: Path,
    depth_topic: str | None,
    camera_topic: str | None,
    params_file: Path | None,
    exact: bool,
) -> None:
    """Segment the depth images of recordings: rosbag2 (mcap, sqlite3) and ROS 1 bags.

    Writes planes.csv (a row for each plane and frame) and for each frame
    <frame>_<stamp>_labels.png (16 bits, 0 = no plane) and <frame>_<stamp>_overlay.png. Several
    BAGs count as one sequence. A damaged one is read up to the damage, and the exit code is 1.
    """
    segmenter = make_segmenter(params_file, exact)
    index = 0
    reasons: dict[str, int] = {}
    damaged = False
    with ExitStack() as stack:
        # All are opened, and so checked, before anything is written.
        recordings = [
            stack.enter_context(DepthBag(bag, depth_topic, camera_topic)) for bag in bags
        ]
        output.mkdir(parents=True, exist_ok=True)
        table = stack.enter_context(PlaneTable(output / 'planes.csv', ('frame', 'stamp')))
        for recording in recordings:
            click.echo(f'{recording.path}: {recording.depth_topic}, {recording.camera_topic}')
            try:
                for frame in options.progress(recording, len(recording), 'frame'):
                    image = RangeImage.from_depth(frame.depth, frame.camera)
                    result = segmenter.segment(image)
                    stamp = '{}.{:09d}'.format(*divmod(frame.stamp, 10**9))
                    write_pictures(output, f'{index:06d}_{stamp}', image, result)
                    table.write(result.planes, index, stamp)
                    if not result.planes:
                        reasons[result.reason] = reasons.get(result.reason, 0) + 1
                    index += 1
            except DamagedBagError as error:
                click.echo(f'rangeseg: {error}', err=True)
                damaged = True
    for reason, count in reasons.items():
        click.echo(f'{count} frames without a plane: {reason}')
    click.echo(f'{output}: {index} frames')
    if damaged:
        ctx.exit(1)
