"""`rangeseg tracks`: how well planes keep their ids, measured on simulated moving cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from rangeseg_ros.cli import options
from rangeseg_ros.evaluation.tracks import track_figures, track_rooms

_ROWS = {
    'switches_per_100_frames': 'switches of id per 100 frames',
    'transfers': 'ids that moved to another face',
    'fragmentations': 'faces lost in sight and found again',
    'ids_per_face': 'ids per face',
    'track_length': 'frames a face kept an id',
    'coverage': 'share of the faces that were found',
}


@click.command()
@options.count('--rooms', default=3)
@options.count('--frames', default=100, help='Of each room, at 30 Hz.')
@options.number('--seed', default=0)
@options.count('--speed', default=1, help='Times that of a hand: up to 0.3 m/s and 15 degrees/s.')
@options.params
@options.json_file
def command(
    rooms: int,
    frames: int,
    seed: int,
    speed: int,
    params_file: Path | None,
    json_file: Path | None,
) -> None:
    """Track planes in simulated rooms that a Kinect moves through, and compare with the truth.

    A face of the room counts while at least 1000 pixels of it are in sight. It stays with its id
    as long as a plane on it has that id, or lies on the surface of that id; the figures are given
    for both.
    """
    config = options.read_parameters(params_file)
    run = track_rooms(range(seed, seed + rooms), frames, speed, config)
    found = list(options.progress(run, rooms * frames, 'frame'))
    figures: dict[str, Any] = {
        'planes': track_figures([frame.planes for frame in found]),
        'surfaces': track_figures([frame.surfaces for frame in found]),
        'median_ms': float(np.median([frame.milliseconds for frame in found])),
    }
    total = figures['planes']
    click.echo(f'{rooms} rooms, {total["frames"]} frames, {total["faces"]} faces')
    click.echo(f'{"":38}{"planes":>9}{"surfaces":>9}')
    for key, text in _ROWS.items():
        values = ''.join(f'{figures[kind][key]:9.3g}' for kind in ('planes', 'surfaces'))
        click.echo(f'{text:38}{values}')
    click.echo(f'{"tracking, ms per frame (median)":38}{figures["median_ms"]:9.3g}')
    options.write_json(json_file, figures)
