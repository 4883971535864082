"""`rangeseg segment`: depth images to labels and planes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from rangeseg_ros.batch.frame_files import FRAME_FILES, frame_path, write_frame
from rangeseg_ros.cli import options
from rangeseg_ros.cli.errors import one_line
from rangeseg_ros.compilation.preparation import prepare, show
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.camera import CameraError
from rangeseg_ros.core.sequence import with_roles
from rangeseg_ros.io.corrections import corrected
from rangeseg_ros.io.depth_files import Intrinsics, files_in, read_frame, scale_of

# Outputs of the node that show what the files hold, so that they need the same kernels.
_SHOWN = ('labels', 'planes', 'overlay', 'normals', 'terrain', 'stairs')


@click.command()
@click.argument('depth', nargs=-1, required=True, type=options.EXISTING)
@options.intrinsics
@options.output_folder()
@options.depth_scale
@options.config('exact')
@options.overwrite
@click.option(
    '--normals',
    is_flag=True,
    help='Also write <stem>_normals.tiff: the reconstructed normals, float32, red, green and blue '
    'are x, y and z towards the sensor, NaN where there is no plane.',
)
@click.option(
    '--curved',
    is_flag=True,
    help='Also write <stem>_curved.png: smooth regions that are no planes, 16 bits, 0 = none.',
)
@click.option(
    '--sensor', is_flag=True, help='Also print the errors of the sensor as every image shows them.'
)
@click.pass_context
def command(
    ctx: click.Context,
    depth: tuple[Path, ...],
    intrinsics: Intrinsics,
    output: Path,
    depth_scale: float | None,
    config: Config,
    overwrite: bool,
    sensor: bool,
    **asked: bool,
) -> None:
    """Segment DEPTH images or organised clouds into planes.

    Files or folders of them: PNG, TIFF, PGM, PFM, EXR, .npy, .npz (integers in millimetres, floats
    in metres), PCD and PLY, and folders as the benchmark of TUM has them (1/5000 m).

    Writes for each image <stem>_labels.png (16 bits, 0 = no plane), <stem>_planes.csv (a row for
    each plane, metres, x right, y down, z forward), <stem>_overlay.png, <stem>_terrain.png (0
    unknown, 1 ground, 2 obstacle, 3 drop), <stem>_height.tiff (metres above the ground) and
    <stem>_stairs.csv. Nothing that is there already is replaced, unless --overwrite says so.
    """
    frames = [(file, depth_scale or scale_of(path)) for path in depth for file in files_in(path)]
    # A folder may have the results of an earlier run beside its images.
    made = {frame_path(path.parent, path.stem, kind) for path, _ in frames for kind in FRAME_FILES}
    frames = [(path, scale) for path, scale in frames if path in depth or path not in made]
    options.check_distinct((path.stem for path, _ in frames), 'images')
    segmenter = Segmenter(config)
    files = [name for name in FRAME_FILES if asked.get(name, True)]
    outputs = [frame_path(output, path.stem, kind) for path, _ in frames for kind in files]
    options.check_new(outputs, [path for path, _ in frames], overwrite)
    tilted, refused, prepared = 0, 0, set[str]()
    for path, scale in options.progress(frames, len(frames), 'image'):
        try:
            image = corrected(read_frame(path, intrinsics, scale), config)
        except CameraError:  # of all images
            raise
        except (ValueError, OSError) as error:
            options.say(f'rangeseg: {path}: {one_line(error).removeprefix(f"{path}: ")}', err=True)
            refused += 1
            continue
        kind = 'image' if image.camera else 'points'
        if kind not in prepared:
            prepare(config, (kind,), show, _SHOWN)
            prepared.add(kind)
        result = segmenter.segment(image)
        result = replace(result, planes=with_roles(result.planes, config, result.up))
        write_frame(output, path.stem, image, result, files)
        if result.planes:
            options.say(f'{path}: {len(result.planes)} planes, {result.ground or "in no unit"}')
        else:
            options.say(f'{path}: no plane: {result.reason}')
        if not result.verdict.ok and image.valid.any():
            options.say(f'rangeseg: {path}: {result.verdict}', err=True)
        if result.tilt:
            tilted += 1
            if tilted == 1:
                options.say(f'rangeseg: {path}: {result.tilt}', err=True)
        if sensor:
            options.say(f'{path}: {result.sensor}')
    if tilted > 1:
        click.echo(f'rangeseg: up is off in {tilted} images', err=True)
    if refused:
        ctx.exit(2)
