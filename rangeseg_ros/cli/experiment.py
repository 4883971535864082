"""`rangeseg experiment`: the figures and tables of chapter 6 of the thesis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any

import click
import yaml

from rangeseg_ros.cli import options, sensitivity
from rangeseg_ros.cli import tolerances as measures
from rangeseg_ros.core.config import Config
from rangeseg_ros.evaluation import experiments, plots, published
from rangeseg_ros.evaluation.datasets import Case, find_cases
from rangeseg_ros.io.files import replacing
from rangeseg_ros.io.params import read_params


@dataclass(frozen=True)
class Setting:
    """What the options common to all experiments come to."""

    cases: list[Case]
    base: Config
    params: Config | None
    names_method: bool
    bench: experiments.Bench
    output: Path
    images: int | None
    source: str

    def has(self, name: str) -> bool:
        """Whether the set has images that are said to be of that split."""
        return any(getattr(case, 'split', '') == name for case in self.cases)

    def split(self, name: str) -> list[Case]:
        """Images of a split, or all of a set without splits; at most --images of them."""
        cases = [case for case in self.cases if getattr(case, 'split', name) == name]
        if not cases:
            raise click.ClickException(f'the set has no {name} images')
        return cases[: self.images]

    def save(
        self, name: str, rows: list[experiments.Row], plot: Callable[[Path, Any, str], None]
    ) -> None:
        """Write rows as CSV and plot."""
        plots.write_csv(self.output / f'{name}.csv', rows)
        plot(self.output / f'{name}.png', rows, f'{name}, measured on the {self.source}')
        click.echo(f'{self.output / name}.csv, .png')


@click.group()
def command() -> None:
    """Repeat the experiments of the thesis on a set of images with ground truth.

    DIR is a folder that `rangeseg evaluate` knows, such as a segcomp set. Each experiment writes
    a plot (PNG) and a table (CSV), and keeps what it has measured in OUTPUT/cache: interrupted,
    it resumes there. What the thesis leaves open comes from --params; without it, everything is
    as in the thesis.
    """


def experiment(function: Callable[..., None]) -> Callable[..., None]:
    """Give a function the common options, as a `Setting`, and make it a command."""

    @wraps(function)
    def run(
        folder: Path,
        output: Path,
        params_file: Path | None,
        images: int | None,
        real: bool,
        jobs: int | None,
        **rest: Any,
    ) -> None:
        base, given, params = published.THESIS, {'method': 'normals'}, None
        if params_file:
            given = read_params(params_file)
            base = params = Config.from_mapping({'method': 'normals', **given})
        bench = experiments.Bench(
            output / 'cache',
            jobs,
            lambda items, total: options.progress(items, total, 'image'),
        )
        source = f'{"real" if real else "simulated"} set {folder.resolve().name}'
        function(
            Setting(
                find_cases(folder), base, params, 'method' in given, bench, output, images, source
            ),
            **rest,
        )

    for decorate in (
        measures.jobs,
        click.option('--real', is_flag=True, help='DIR is a real set: say so in the results.'),
        click.option(
            '--images', type=click.IntRange(min=1), help='Only so many images of each split.'
        ),
        options.params,
        click.option(
            '--output',
            type=click.Path(file_okay=False, path_type=Path),
            required=True,
            help='Folder for the results; made when missing.',
        ),
        click.argument('folder', metavar='DIR', type=options.FOLDER),
    ):
        run = decorate(run)
    return run


limit = click.option(
    '--limit',
    type=click.IntRange(min=17),
    default=1249,
    show_default=True,
    help='Leave out direction sets with more directions.',
)
step = click.option(
    '--step',
    type=click.IntRange(min=1),
    default=10,
    show_default=True,
    help='Lambda runs from 20 to 150 in such steps; the thesis has 5.',
)


@command.command()
@experiment
@limit
def directions(setting: Setting, limit: int) -> None:
    """Direction sets, without post-processing (figure 6.2)."""
    rows = experiments.directions(setting.bench, setting.split('train'), setting.base, limit)
    setting.save('directions', rows, plots.plot_tolerances)


@command.command('lambda')
@experiment
@step
@click.option(
    '--train',
    'train_file',
    type=click.Path(dir_okay=False, path_type=Path),
    help='Write the parameters, with the lambda that is best with identified noise regions, to '
    'this YAML file.',
)
def lambda_(setting: Setting, step: int, train_file: Path | None) -> None:
    """Lambda and the three post-processings, T = 0.8 (figure 6.3)."""
    values = _lambdas(step)
    rows = experiments.lambdas(setting.bench, setting.split('train'), setting.base, values)
    setting.save('lambda', rows, plots.plot_lambdas)
    if train_file:
        _write_params(train_file, setting, rows)


@command.command()
@experiment
@step
def postprocessing(setting: Setting, step: int) -> None:
    """Post-processings against the tolerance, each at its best lambda (figure 6.4)."""
    values = _lambdas(step)
    rows = experiments.postprocessing(setting.bench, setting.split('train'), setting.base, values)
    setting.save('postprocessing', rows, plots.plot_tolerances)


@command.command()
@experiment
@step
def weights(setting: Setting, step: int) -> None:
    """Neighbourhood weights of section 5.5, each at its best lambda (figure 5.5)."""
    cases = setting.split('train' if setting.has('train') else 'test')
    rows = experiments.weights(setting.bench, cases, setting.base, _lambdas(step))
    setting.save('weights', rows, plots.plot_tolerances)


@command.command()
@experiment
@step
def comparison(setting: Setting, step: int) -> None:
    """Ours on the test images (figure 6.5, table B.1).

    Beside the published results of a Perceptron or ABW set. Lambda is trained on the training
    images; without any, for each image on all others. --params adds rows with these parameters.
    """
    test = setting.split('test')
    sensor = getattr(test[0], 'sensor', '')
    rows = experiments.comparison(
        setting.bench,
        setting.split('train') if setting.has('train') else [],
        test,
        experiments.variants(sensor, setting.params),
        setting.source,
        _lambdas(step),
    )
    rows += published.published_rows(sensor)
    setting.save('comparison', rows, plots.plot_tolerances)


@command.command()
@experiment
@limit
def timing(setting: Setting, limit: int) -> None:
    """Time against the number of labels, all at full resolution (table 6.1). Takes long.

    For times that mean something, run it with --jobs 1 on an idle machine.
    """
    rows = experiments.timing(setting.bench, setting.split('train'), setting.base, limit)
    setting.save('timing', rows, plots.plot_timing)


command.add_command(sensitivity.command, 'sensitivity')


def _lambdas(step: int) -> list[float]:
    return [float(value) for value in range(20, 151, step)]


def _write_params(path: Path, setting: Setting, rows: list[experiments.Row]) -> None:
    """Parameter file with the best lambda and whatever else differs from the defaults.

    Where --params names no method the file names none either: lambda is then there for whoever
    chooses `normals`.
    """
    best = max((r for r in rows if r['series'] == 'identified'), key=lambda row: row['correct'])
    defaults = Config()
    chosen = {
        name: getattr(setting.base, name)
        for name in Config.__dataclass_fields__
        if getattr(setting.base, name) != getattr(defaults, name)
        and (name != 'method' or setting.names_method)
    }
    params = {**chosen, 'smoothness': best['lambda']}
    text = (
        f'# smoothness trained on the {setting.source}, {setting.images or "all"} training '
        f'images: {best["correct"]:.2f} of {best["regions"]:.2f} regions correct at T = 0.8\n'
    )
    text += yaml.safe_dump({'/**': {'ros__parameters': params}}, sort_keys=False)
    with replacing(path) as part:
        part.write_text(text)
