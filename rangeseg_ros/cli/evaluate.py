"""`rangeseg evaluate`: the segmenter measured on images with ground truth."""

from __future__ import annotations

from pathlib import Path

import click

from rangeseg_ros.cli import options
from rangeseg_ros.cli.compare import ToleranceCommand, tolerance
from rangeseg_ros.compilation.preparation import prepare, show
from rangeseg_ros.core.config import Config
from rangeseg_ros.evaluation.datasets import find_cases
from rangeseg_ros.evaluation.detection import detection_table, detections
from rangeseg_ros.evaluation.figures import evaluation_figures, table
from rangeseg_ros.evaluation.measure import Task
from rangeseg_ros.evaluation.terrain import terrain_figures, terrain_table, terrain_tasks
from rangeseg_ros.tasks import run_all


@click.command(cls=ToleranceCommand)
@click.argument('folder', metavar='DIR', type=options.FOLDER)
@options.config('method')
@tolerance
@options.count(
    '--min-pixels', help='Smaller regions of true depth images do not count.  [default: 1000]'
)
@click.option(
    '--split', type=click.Choice(['train', 'test']), help='Only this part of a segcomp set.'
)
@click.option(
    '--unknown-height',
    is_flag=True,
    help='Terrains: do not give the height of the sensor to the segmenter.',
)
@options.jobs
@options.output_folder(
    "Folder for each image's labels and a picture of truth and segmentation at tolerance 0.8: "
    'correct white, over-segmented green, under-segmented blue, missed orange, noise red.',
    required=False,
)
@options.overwrite
@options.json_file
def command(
    folder: Path,
    config: Config,
    tolerances: tuple[float, ...],
    min_pixels: int | None,
    split: str | None,
    unknown_height: bool,
    jobs: int | None,
    output: Path | None,
    overwrite: bool,
    json_file: Path | None,
) -> None:
    """Segment the images in DIR and compare the results with their ground truth.

    \b
    Known layouts of DIR:
      abw.test.N.range, perc.test.N (or train) with .gt-seg, .gt-ang
      depth/*.png, truth/*.png, camera.yaml, as `simulate kinect` writes
      folders of depth.png or .tiff, truth.png and camera.txt (fx fy cx cy)
      labelled laser scans *.pcd (x forward, z up, intensity >= 10)
      terrain.csv, as `simulate terrain` or `testpieces` write: terrain classes

    Prints the averages per image. The JSON file has the sums over the images in `tolerances`,
    with errors of angles and planes where the truth knows them, and each image in `per_image`.
    """
    if (folder / 'terrain.csv').exists():
        terrains = terrain_tasks(folder, config, not unknown_height, output)
        if output:
            options.check_new([terrain.picture for terrain in terrains], [], overwrite)
        prepare(config, ('image',), show, ('terrain',))
        measured = list(options.progress(run_all(terrains, jobs), len(terrains), 'image'))
        figures = terrain_figures(measured)
        click.echo(f'{folder}: {len(measured)} images')
        pieces = detections(measured)
        if pieces:
            figures['detection'] = [row._asdict() for row in pieces]
        click.echo(detection_table(pieces) if pieces else terrain_table(figures))
        options.write_json(json_file, figures)
        return
    known = find_cases(folder, min_pixels)
    cases = [case for case in known if split is None or case.split in (split, '')]
    if not cases:
        raise click.ClickException(f'{folder}: no {split} images')
    tasks = [Task(case, config, output=output) for case in cases]
    if output:
        outputs = [path for task in tasks for path in task.pictures(output).values()]
        inputs = [path for case in cases for path in (case.image, case.truth)]
        options.check_new(outputs, inputs, overwrite)
    prepare(config, ('image',), show, ())
    found = list(options.progress(run_all(tasks, jobs), len(tasks), 'image'))
    figures = evaluation_figures(found, tolerances)
    click.echo(f'{folder}: {len(cases)} images, method {config.method}')
    click.echo(table(figures))
    options.write_json(json_file, figures)
