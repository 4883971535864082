"""`rangeseg compare`: label images against ground truth."""

from __future__ import annotations

from pathlib import Path

import click

from rangeseg_ros.cli import options
from rangeseg_ros.cli import tolerances as measures
from rangeseg_ros.evaluation.figures import Compared, comparison_figures, table
from rangeseg_ros.evaluation.label_files import (
    as_truth,
    pair_files,
    read_angles_beside,
    read_label_image,
    read_normals_beside,
)
from rangeseg_ros.evaluation.overlap import ComparisonError


@click.command(cls=measures.ToleranceCommand)
@click.argument('truth', metavar='GT', type=click.Path(exists=True, path_type=Path))
@click.argument('labels', metavar='MS', type=click.Path(exists=True, path_type=Path))
@measures.tolerance
@click.option(
    '--min-pixels',
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help='Regions of the ground truth that are smaller do not count as regions.',
)
@measures.json_file
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
    images = {}
    pairs = pair_files(truth, labels)
    for name, (truth_file, labels_file) in options.progress(pairs.items(), len(pairs), 'image'):
        known = as_truth(read_label_image(truth_file), min_pixels)
        try:
            overlap = known.compare(read_label_image(labels_file))
        except ComparisonError as error:
            raise ComparisonError(f'{labels_file}: {error}') from None
        angles, normals = read_angles_beside(truth_file), read_normals_beside(labels_file)
        images[name] = Compared(overlap, angles, normals)
    figures = comparison_figures(images, tolerances)
    click.echo(table(figures))
    if json_file:
        measures.write_json(json_file, figures)
