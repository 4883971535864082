"""`rangeseg experiment`: the figures and tables of chapter 6 of the thesis."""

from __future__ import annotations

from pathlib import Path

import click
import yaml

from rangeseg_ros.cli import options
from rangeseg_ros.core.config import Config
from rangeseg_ros.evaluation import experiments, plots, published
from rangeseg_ros.evaluation.datasets import Case, find_cases
from rangeseg_ros.io.files import replacing
from rangeseg_ros.io.params import read_params

NAMES = ('directions', 'lambda', 'postprocessing', 'weights', 'comparison')


@click.command()
@click.argument('name', metavar='EXPERIMENT', type=click.Choice(NAMES))
@click.argument('folder', metavar='DIR', type=options.FOLDER)
@options.output_folder()
@options.params
@options.count('--images', help='Only so many images of each split.')
@click.option('--real', is_flag=True, help='DIR is a real set: say so in the results.')
@click.option(
    '--limit',
    type=click.IntRange(min=17),
    default=1249,
    show_default=True,
    help='directions: leave out sets with more directions.',
)
@options.count('--step', default=10, help='Of lambda from 20 to 150; the thesis has 5.')
@options.output_file(
    '--train',
    'lambda: write the parameters, with the lambda that is best with identified noise regions, to '
    'this YAML file.',
)
@options.jobs
def command(
    name: str,
    folder: Path,
    output: Path,
    params_file: Path | None,
    images: int | None,
    real: bool,
    limit: int,
    step: int,
    train: Path | None,
    jobs: int | None,
) -> None:
    """Repeat an experiment of the thesis on a set of images with ground truth.

    \b
    directions      sets of directions, without post-processing (figure 6.2)
    lambda          lambda and the three post-processings, T = 0.8 (figure 6.3)
    postprocessing  post-processings against the tolerance (figure 6.4)
    weights         neighbourhood weights of section 5.5 (figure 5.5)
    comparison      ours on the test images, beside published results of a
                    Perceptron or ABW set (figure 6.5, table B.1)

    DIR is a folder that `rangeseg evaluate` knows, such as a segcomp set. Writes a plot (PNG) and
    a table (CSV). Parameters that the experiment does not vary come from --params; without it,
    they are those of the thesis. `comparison` adds rows with the parameters of --params.
    """
    if train and name != 'lambda':
        raise click.UsageError('--train is for the experiment lambda')
    given = read_params(params_file) if params_file else None
    params = None if given is None else Config.from_mapping({'method': 'normals', **given})
    base = params or published.THESIS
    lambdas = [float(value) for value in range(20, 151, step)]
    source = f'{"real" if real else "simulated"} set {folder.resolve().name}'
    bench = experiments.Bench(jobs, lambda items, total: options.progress(items, total, 'image'))
    cases = find_cases(folder)
    training, test = _split(cases, 'train', images), _split(cases, 'test', images)
    needed = {'comparison': test, 'weights': training or test}.get(name, training)
    if not needed:
        kind = 'test' if name == 'comparison' else 'train'
        raise click.ClickException(f'the set has no {kind} images')
    if name == 'comparison':
        separate = training if any(hasattr(case, 'split') for case in cases) else []
        sensor = getattr(test[0], 'sensor', '')
        variants = experiments.compared(sensor, params)
        rows = [
            {'series': row['series'], 'source': source, **row}
            for row in experiments.comparison(bench, separate, test, variants, lambdas)
        ] + published.published_rows(sensor)
    elif name == 'directions':
        leaving = Config.from_mapping({**vars(base), 'noise_regions': 'leave'})
        sets = experiments.direction_sets(leaving, limit)
        rows = experiments.by_tolerance(bench.train(sets, experiments.HIGH_LAMBDAS, training))
    else:
        changes = experiments.WEIGHTS if name == 'weights' else experiments.POSTPROCESSING
        found = bench.train(experiments.vary(base, changes), lambdas, needed)
        table = experiments.by_lambda if name == 'lambda' else experiments.by_tolerance
        rows = table(found)
    plots.write_csv(output / f'{name}.csv', rows)
    against = 'lambda' if name == 'lambda' else 'tolerance'
    title = f'{name}, measured on the {source}'
    plots.plot_correct(output / f'{name}.png', rows, title, against)
    click.echo(f'{output / name}.csv, .png')
    if train:
        about = f'{source}, {images or "all"} training images'
        names_method = given is None or 'method' in given
        _write_params(train, base, names_method, about, rows)


def _split(cases: list[Case], name: str, images: int | None) -> list[Case]:
    """Images of a split, or all of a set without splits; at most so many of them."""
    return [case for case in cases if getattr(case, 'split', name) == name][:images]


def _write_params(
    path: Path, base: Config, names_method: bool, about: str, rows: list[experiments.Row]
) -> None:
    """Parameter file with the best lambda and whatever else differs from the defaults.

    Where --params names no method, the file names none: lambda then counts with `normals` only.
    """
    best = max((r for r in rows if r['series'] == 'identified'), key=lambda row: row['correct'])
    params = {
        name: value
        for name, value in vars(base).items()
        if value != getattr(Config(), name) and (name != 'method' or names_method)
    }
    params['smoothness'] = best['lambda']
    text = (
        f'# smoothness trained on the {about}: '
        f'{best["correct"]:.2f} of {best["regions"]:.2f} regions correct at T = 0.8\n'
    )
    text += yaml.safe_dump({'/**': {'ros__parameters': params}}, sort_keys=False)
    with replacing(path) as part:
        part.write_text(text)
