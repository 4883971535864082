"""Plots and CSV files of the experiments."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from rangeseg_ros.evaluation.experiments import Row
from rangeseg_ros.io.files import replacing

# Styles in which coinciding lines stay visible.
_LAPPING: tuple[dict[str, Any], ...] = (
    {'marker': '.'},
    {'marker': 's', 'linewidth': 4, 'alpha': 0.4},
    {'marker': 'o', 'linestyle': '--', 'markersize': 3},
)
METRICS = ('correct', 'over', 'under', 'missed', 'noise')


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows under the columns of all of them; numbers to six significant digits."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with replacing(path) as partial, partial.open('w', newline='') as file:
        writer = csv.DictWriter(file, columns, lineterminator='\n')
        writer.writeheader()
        for row in rows:
            writer.writerow({key: _text(value) for key, value in row.items()})


def _text(value: Any) -> Any:
    return f'{value:.6g}' if isinstance(value, float) else value


def plot_tolerances(path: Path, rows: Sequence[Row], title: str) -> None:
    """Correct regions against the tolerance, a line for each series; published ones dotted."""
    figure = Figure(figsize=(9.5, 5.5), layout='constrained')
    axes = figure.subplots()
    colours = iter(colormaps['tab20'](range(0, 20)))
    for name, part in _series(rows).items():
        label = name
        style: dict[str, Any] = {'marker': 'o'}
        if _published(part[0]):
            label += ', published'
            style = {'linestyle': ':', 'marker': '', 'color': next(colours), 'linewidth': 1.2}
            if name.startswith('thesis'):
                style |= {'color': 'black', 'linestyle': '--', 'marker': 's', 'markersize': 4}
            if len(part) == 1:
                style['marker'] = 'x'
        elif part[0].get('lambda'):
            label += f' (λ = {part[0]["lambda"]:g})'
        x = [100 * row['tolerance'] for row in part]
        axes.plot(x, [row['correct'] for row in part], label=label, **style)
    ours = [row['regions'] for row in rows if not _published(row)]
    axes.axhline(ours[0], color='grey', linestyle='--', linewidth=0.8, label='regions in the set')
    _finish(axes, 'tolerance T, %', 'correct regions per image')
    figure.legend(fontsize=8, loc='outside right upper')
    if any(_published(row) for row in rows):
        title += (
            '; published: ' + next(r['source'] for r in rows if _published(r)).partition(',')[0]
        )
    axes.set_title(title, fontsize=10)
    _save(path, figure)


def _published(row: Row) -> bool:
    return 'published' in row.get('source', '')


def plot_lambdas(path: Path, rows: Sequence[Row], title: str) -> None:
    """The five metrics against lambda, a panel each."""
    figure = Figure(figsize=(13, 7), layout='constrained')
    panels = figure.subplots(2, 3).ravel()
    for axes, metric in zip(panels, METRICS, strict=False):
        for (name, part), style in zip(_series(rows).items(), _LAPPING, strict=False):
            x = [row['lambda'] for row in part]
            axes.plot(x, [row[metric] for row in part], label=name, **style)
        if metric in ('noise', 'over'):
            axes.set_yscale('symlog', linthresh=1)
        _finish(axes, 'λ', f'{metric} regions per image')
    panels[0].legend()
    panels[-1].axis('off')
    figure.suptitle(title)
    _save(path, figure)


def plot_timing(path: Path, rows: Sequence[Row], title: str) -> None:
    """Seconds against the number of labels, with the thesis's."""
    figure = Figure(figsize=(8, 5.5), layout='constrained')
    axes = figure.subplots()
    for moves in dict.fromkeys(row['moves'] for row in rows):
        part = sorted((r for r in rows if r['moves'] == moves), key=lambda row: row['labels'])
        x, y = [row['labels'] for row in part], [row['mean_s'] for row in part]
        axes.plot(x, y, marker='o', label=f'{moves}, here')
    published = sorted((r['labels'], r['thesis_mean_s']) for r in rows if r['thesis_mean_s'] != '')
    axes.plot(*zip(*published, strict=True), 'k:s', label='expansion, thesis (2012)')
    axes.set_xscale('log')
    axes.set_yscale('log')
    counts = sorted({row['labels'] for row in rows})
    # Numbers of Platonic and of regular sets that are close would print over each other.
    shown = [n for k, n in enumerate(counts) if k == 0 or n > 1.15 * counts[k - 1]]
    axes.set_xticks(shown, [str(n) for n in shown])
    axes.minorticks_off()
    axes.yaxis.set_major_formatter(FuncFormatter(lambda seconds, _: f'{seconds:g}'))
    _finish(axes, 'labels', 'seconds per image for the labelling')
    axes.legend()
    figure.suptitle(title)
    _save(path, figure)


def _series(rows: Sequence[Row]) -> dict[str, list[Row]]:
    series: dict[str, list[Row]] = {}
    for row in rows:
        series.setdefault(row['series'], []).append(row)
    return series


def _finish(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.3)


def _save(path: Path, figure: Figure) -> None:
    FigureCanvasAgg(figure)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110)
