"""`rangeseg calibrate`: recordings to the distortion map of their sensor."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import click
import numpy as np
import yaml

from rangeseg_ros.batch.calibration import ResidualsOfFrame, Seen, Source, parts
from rangeseg_ros.cli import options
from rangeseg_ros.core.calibration.calibrate import Calibration, calibrate
from rangeseg_ros.core.calibration.sightings import Sightings, concatenate
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.sensing.distortion import DistortionError
from rangeseg_ros.io.cameras import read_camera
from rangeseg_ros.io.distortion import read_distortion, write_distortion
from rangeseg_ros.io.files import NotReplacedError, replacing
from rangeseg_ros.io.params import read_config, read_params
from rangeseg_ros.report.calibration import Shown, write_calibration
from rangeseg_ros.report.page import page_kind
from rangeseg_ros.tasks import run_all

# Frames that the report shows.
_SHOWN = 3
_HEADER = '# Written by rangeseg calibrate.\n'


@click.command()
@click.argument(
    'recordings', metavar='RECORDING...', nargs=-1, required=True, type=options.EXISTING
)
@options.output_file('--output', 'Distortion map to write: TIFF.', required=True)
@options.output_file('--params', 'Parameter file to write: with the map.')
@options.camera()
@options.depth_scale
@options.topics
@click.option(
    '--segment-with',
    type=options.FILE,
    help='Parameters of the segmenter, which --params repeats.  [default: those of the package]',
)
@options.jobs
def command(
    recordings: tuple[Path, ...],
    output: Path,
    params: Path | None,
    camera_file: Path | None,
    segment_with: Path | None,
    jobs: int | None,
    **given: Any,
) -> None:
    """Learn the fixed distortion of a sensor from the planes in RECORDINGs of it.

    Recordings are bags of depth images or of organised clouds (z forward), or folders of depth
    images in the order of their names, with --camera.
    Writes the map and, beside it, <stem>_report.html. See docs/calibration.md for how to record.

    An interrupted run goes on where it was when it is started again.
    """
    report = output.with_name(f'{output.stem}_report.html')
    _check_free(output, params, report)
    camera = read_camera(camera_file) if camera_file else None
    sources = [Source(path, camera, **given) for path in recordings]
    for source in sources:
        if source.is_folder and not source.files():
            raise click.UsageError(f'{source.path}: neither a bag nor a folder of depth images')
        if source.is_folder and camera is None:
            raise click.UsageError(f'{source.path}: a folder of images needs --camera')
    # What is learned is the whole distortion, not what another map leaves.
    config = read_config(segment_with, distortion_map='')
    kept = output.with_name(f'.{output.name}.parts')
    tasks = parts(sources, config, kept)
    seen = [each for each in options.progress(run_all(tasks, jobs), len(tasks), 'part') if each]
    if not seen:
        raise click.ClickException(f'{", ".join(map(str, recordings))}: no frames')
    if lost := sum(t.after - t.first for t in tasks) - sum(part.sightings.frames for part in seen):
        click.echo(f'rangeseg: {lost} frames left out that cannot be read', err=True)
    result = calibrate(*_together(seen))
    _report(result)

    numbered = [(source, number) for source in sources for number in range(len(source))]
    chosen = np.linspace(0, len(numbered) - 1, min(_SHOWN, len(numbered))).round().astype(int)
    frames = [
        ResidualsOfFrame(source, config, number, result.distortion)
        for source, number in (numbered[n] for n in chosen)
    ]
    left = list(options.progress(run_all(frames, jobs), len(frames), 'frame'))
    parameters = read_params(segment_with) if segment_with else {}
    parameters['distortion_map'] = str(output.absolute())
    Config.from_mapping(parameters)
    write_distortion(output, result.distortion)
    if params:
        with replacing(params) as partial:
            partial.write_text(_HEADER + yaml.safe_dump(parameters, sort_keys=False))
    pairs = zip(chosen.tolist(), left, strict=True)
    shown = [Shown(number, frame.images, frame.planes) for number, frame in pairs if frame]
    write_calibration(report, [path.name for path in recordings], result, parameters, shown)
    shutil.rmtree(kept, ignore_errors=True)
    click.echo(f'{output}, {report}')


def _check_free(output: Path, params: Path | None, report: Path) -> None:
    """Refuse to overwrite what is none of this command's own."""
    if output.exists():
        try:
            read_distortion(output)
        except DistortionError:
            raise click.UsageError(f'{output}: exists already, and is no distortion map') from None
    if params:
        options.check_replaceable(params, _HEADER.encode())
    if report.exists() and page_kind(report) != 'calibration':
        raise NotReplacedError(report)


def _together(seen: list[Seen]) -> tuple[Sightings, tuple[int, int], Any]:
    """Sightings of all recordings, the size of their images and their camera."""
    sizes = {part.shape for part in seen}
    if len(sizes) > 1:
        text = ', '.join(f'{width}x{height}' for height, width in sorted(sizes))
        raise click.UsageError(f'images of several sizes: {text}')
    if len({part.camera for part in seen}) > 1:
        raise click.UsageError('recordings of several cameras')
    return concatenate([part.sightings for part in seen]), seen[0].shape, seen[0].camera


def _report(result: Calibration) -> None:
    less = 1 - result.after / result.before
    click.echo(
        f'residual of planes on frames left out: {result.before:.5f} to {result.after:.5f} 1/m, '
        f'{less:.0%} less'
    )
    deviation = result.distortion.deviation
    assert deviation is not None
    rms, unsure = (
        float(np.sqrt((image**2).mean())) for image in (result.distortion.offset, deviation)
    )
    click.echo(f'distortion {rms:.5f} 1/m, known to {unsure:.5f} 1/m')
    if result.distortion.slope is not None:
        click.echo('it depends on the distance: the map has a second coefficient')
    if rms < unsure or less < 0.01:
        click.echo('no fixed distortion that stands out: the map will change next to nothing')
