"""`rangeseg view`: planes in 3D, as a Rerun recording."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

from rangeseg_ros.batch.locator import Locator
from rangeseg_ros.batch.replay import segment_frames
from rangeseg_ros.cli import options
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.drawing import colours, grey
from rangeseg_ros.extras import load
from rangeseg_ros.io.bags import DepthBag
from rangeseg_ros.io.files import replacing

ARROW_LENGTH = 0.2
"""Length of the drawn normals, metres."""


@click.command()
@click.argument('bag', type=click.Path(path_type=Path))
@click.option(
    '--output',
    type=click.Path(dir_okay=False, path_type=Path),
    required=True,
    help='Rerun recording to write (.rrd); `rerun FILE` shows it.',
)
@options.topics
@options.raw
@options.fixed_frame
@options.params
@options.exact
@click.pass_context
def command(
    ctx: click.Context,
    bag: Path,
    output: Path,
    depth_topic: str | None,
    camera_topic: str | None,
    raw: bool,
    fixed_frame: str | None,
    params_file: Path | None,
    exact: bool,
) -> None:
    """Segment a recording and log what is found, to look at in 3D.

    Cloud, hulls and normals in the colours of the planes' ids, and the labels as an image; in a
    fixed frame, or with the parameter odometry, the map of planes as it is in the end. Needs
    the extra view (rerun-sdk), whose telemetry is off. What is damaged is left out, and the exit
    code is then 1.
    """
    config = options.read_parameters(params_file, exact=exact, fixed_frame=fixed_frame)
    options.check_replaceable(output, b'RRF')
    rerun = _rerun()
    sequence = SequenceSegmenter(config)
    with (
        DepthBag(bag, depth_topic, camera_topic, raw) as source,
        Locator(bag, config) as located,
        replacing(output) as file,
    ):
        log = rerun.RecordingStream('rangeseg', recording_id=output.stem, send_properties=False)
        log.save(file)
        log.log('camera', rerun.ViewCoordinates.RDF, static=True)
        count = 0
        show = partial(options.progress, unit='frame')
        for index, frame, image, result in segment_frames(source, sequence, located.place, show):
            log.set_time('frame', sequence=index)
            log.set_time('stamp', timestamp=np.datetime64(frame.stamp, 'ns'))
            if sequence.pose:
                turn, shift = sequence.pose
                log.log('camera', rerun.Transform3D(translation=shift, mat3x3=turn))
            _log_frame(rerun, log, image, result)
            count += 1
        if config.map_frame:
            log.log('map', _outlines(rerun, sequence.map.planes), static=True)
        log.flush()
        log.disconnect()
        problems = list(filter(None, (source.damage, source.loss())))
    click.echo(f'{output}: {count} frames')
    for problem in problems:
        click.echo(f'rangeseg: {problem}', err=True)
    if problems:
        ctx.exit(1)


def _rerun() -> Any:
    # Read when the library is loaded.
    os.environ['TELEMETRY_ENABLED'] = 'false'
    return load('rerun')


def _log_frame(rerun: Any, log: Any, image: RangeImage, result: Segmentation) -> None:
    planes = result.planes
    tints = colours([plane.id for plane in planes])
    names = [f'{plane.id} {plane.role}' for plane in planes]
    pixels = np.repeat(grey(image.inverse)[..., None], 3, axis=2)
    for plane, tint in zip(planes, tints, strict=True):
        pixels[result.labels == plane.label] = tint
    log.log('camera/cloud', rerun.Points3D(image.points[image.valid], colors=pixels[image.valid]))
    log.log(
        'camera/hulls',
        _outlines(rerun, planes),
    )
    log.log(
        'camera/normals',
        rerun.Arrows3D(
            origins=[plane.centroid for plane in planes],
            vectors=[ARROW_LENGTH * plane.normal for plane in planes],
            colors=tints,
            labels=names,
        ),
    )
    classes = [
        (plane.label, name, tint) for plane, name, tint in zip(planes, names, tints, strict=True)
    ]
    log.log('labels', rerun.AnnotationContext([(0, 'no plane', (0, 0, 0)), *classes]))
    log.log('labels', rerun.SegmentationImage(result.labels))


def _outlines(rerun: Any, planes: Sequence[Plane]) -> Any:
    """Borders of planes and of their holes, in the colours of their ids."""
    tints = colours([plane.id for plane in planes])
    lines = [
        (tint, ring)
        for plane, tint in zip(planes, tints, strict=True)
        for part in plane.outline.parts
        for ring in part
    ]
    closed = [np.vstack([ring, ring[:1]]) for _, ring in lines]
    return rerun.LineStrips3D(closed, colors=[tint for tint, _ in lines])
