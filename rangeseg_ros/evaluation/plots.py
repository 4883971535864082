"""Plots and CSV files of the experiments."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

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
        writer.writerows(
            {k: f'{v:.6g}' if isinstance(v, float) else v for k, v in row.items()} for row in rows
        )


def plot_tolerances(path: Path, rows: Sequence[Row], title: str) -> None:
    """Correct regions against the tolerance, a line for each series; published ones dotted."""
    with _figure(path, title, (9.5, 5.5)) as figure:
        axes = _labelled(figure.subplots(), 'tolerance T, %', 'correct regions per image')
        colours = iter(colormaps['tab20'](range(0, 20)))
        for name, part in _series(rows).items():
            label = name
            style: dict[str, Any] = {'marker': 'o'}
            if 'published' in part[0].get('source', ''):
                label += ', published'
                style = {'linestyle': ':', 'color': next(colours), 'linewidth': 1.2}
                if name.startswith('thesis'):
                    style |= {'color': 'black', 'linestyle': '--', 'marker': 's', 'markersize': 4}
                if len(part) == 1:
                    style['marker'] = 'x'
            elif part[0].get('lambda'):
                label += f' (λ = {part[0]["lambda"]:g})'
            x = [100 * row['tolerance'] for row in part]
            axes.plot(x, [row['correct'] for row in part], label=label, **style)
        axes.axhline(rows[0]['regions'], color='grey', linestyle='--', label='regions in the set')
        figure.legend(fontsize=8, loc='outside right upper')


def plot_lambdas(path: Path, rows: Sequence[Row], title: str) -> None:
    """The five metrics against lambda, a panel each."""
    with _figure(path, title, (13, 7)) as figure:
        panels = figure.subplots(2, 3).ravel()
        for axes, metric in zip(panels, METRICS, strict=False):
            for (name, part), style in zip(_series(rows).items(), _LAPPING, strict=False):
                x = [row['lambda'] for row in part]
                axes.plot(x, [row[metric] for row in part], label=name, **style)
            if metric in ('noise', 'over'):
                axes.set_yscale('symlog', linthresh=1)
            _labelled(axes, 'λ', f'{metric} regions per image')
        panels[0].legend()
        panels[-1].axis('off')


def plot_timing(path: Path, rows: Sequence[Row], title: str) -> None:
    """Seconds against the number of labels, with the thesis's."""
    with _figure(path, title, (8, 5.5)) as figure:
        axes = _labelled(figure.subplots(), 'labels', 'seconds per image for the labelling')
        axes.set_xscale('log')
        axes.set_yscale('log')
        for moves in dict.fromkeys(row['moves'] for row in rows):
            points = sorted((r['labels'], r['mean_s']) for r in rows if r['moves'] == moves)
            axes.plot(*zip(*points, strict=True), marker='o', label=f'{moves}, here')
        points = sorted((r['labels'], r['thesis_mean_s']) for r in rows if r['thesis_mean_s'])
        axes.plot(*zip(*points, strict=True), 'k:s', label='expansion, thesis (2012)')
        axes.legend()


def _series(rows: Sequence[Row]) -> dict[str, list[Row]]:
    series: dict[str, list[Row]] = {}
    for row in rows:
        series.setdefault(row['series'], []).append(row)
    return series


def _labelled(axes: Axes, x: str, y: str) -> Axes:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.3)
    return axes


@contextmanager
def _figure(path: Path, title: str, size: tuple[float, float]) -> Iterator[Figure]:
    figure = Figure(figsize=size, layout='constrained')
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=10)
    yield figure
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110)
