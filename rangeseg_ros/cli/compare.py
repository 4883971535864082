"""`rangeseg compare`: label images against ground truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from rangeseg_ros.cli import options
from rangeseg_ros.evaluation.figures import TOLERANCES, evaluation_figures, table
from rangeseg_ros.evaluation.label_files import (
    as_truth,
    pair_files,
    read_angles_beside,
    read_label_image,
    read_normals_beside,
)
from rangeseg_ros.evaluation.measure import Measurement
from rangeseg_ros.evaluation.overlap import ComparisonError, check_tolerance


class ToleranceCommand(click.Command):
    """A command whose `--tolerance` takes all the numbers that follow it."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        spread: list[str] = []
        taking = False
        for arg in args:
            number = _is_number(arg)
            if taking and number and spread[-1] != '--tolerance':
                spread.append('--tolerance')
            taking = arg == '--tolerance' or (taking and number)
            spread.append(arg)
        return super().parse_args(ctx, spread)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


tolerance: Callable[..., Any] = click.option(
    '--tolerance',
    'tolerances',
    type=float,
    multiple=True,
    callback=lambda context, option, values: tuple(map(check_tolerance, values or TOLERANCES)),
    metavar='T...',
    help=f'Overlap from which regions match, in (0.5, 1]; several may follow.  '
    f'[default: {" ".join(map(str, TOLERANCES))}]',
)


@click.command(cls=ToleranceCommand)
@click.argument('truth', metavar='GT', type=click.Path(exists=True, path_type=Path))
@click.argument('labels', metavar='MS', type=click.Path(exists=True, path_type=Path))
@tolerance
@options.count('--min-pixels', default=1, help='Smaller regions of the truth do not count.')
@options.json_file
def command(
    truth: Path,
    labels: Path,
    tolerances: tuple[float, ...],
    min_pixels: int,
    json_file: Path | None,
) -> None:
    """Compare a segmentation MS with the ground truth GT by Hoover's metrics.

    Two label images, or two folders of them, paired by name: segcomp rasters (.gt-seg, .ms-seg;
    regions from 10) or PNGs (0 = none). A ground truth with the label 65535, judged not to be
    planar, is compared over its judged pixels only: there 0 means not judged.

    Angles are compared where a .gt-ang lies beside the truth and a .ms-nor beside the
    segmentation.

    Prints the averages per image. The JSON file has the sums over the images in `tolerances`
    (mean_iou and pixel_accuracy over all regions and pixels), and each image in `per_image`.
    """
    images = []
    pairs = pair_files(truth, labels)
    for name, (truth_file, labels_file) in options.progress(pairs.items(), len(pairs), 'image'):
        known = as_truth(read_label_image(truth_file), min_pixels)
        try:
            overlap = known.compare(read_label_image(labels_file))
        except ComparisonError as error:
            raise ComparisonError(f'{labels_file}: {error}') from None
        angles, normals = read_angles_beside(truth_file), read_normals_beside(labels_file)
        images.append(Measurement(name, overlap, angles, {}, normals, {}))
    figures = evaluation_figures(images, tolerances)
    click.echo(table(figures))
    options.write_json(json_file, figures)
