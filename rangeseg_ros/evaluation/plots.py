"""Plots and CSV files of the experiments."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rangeseg_ros.evaluation.experiments import Row
from rangeseg_ros.io.files import replacing


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows under the columns of all of them; numbers to six significant digits."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with replacing(path) as partial, partial.open('w', newline='') as file:
        writer = csv.DictWriter(file, columns, lineterminator='\n')
        writer.writeheader()
        writer.writerows(
            {k: f'{v:.6g}' if isinstance(v, float) else v for k, v in row.items()} for row in rows
        )


def plot_correct(path: Path, rows: Sequence[Row], title: str, against: str) -> None:
    """Correct regions against the column `against`, a line for each series; published dotted."""
    figure = Figure(figsize=(9.5, 5.5), layout='constrained')
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=10)
    axes = figure.subplots()
    for name in dict.fromkeys(row['series'] for row in rows):
        part = [row for row in rows if row['series'] == name]
        published = 'published' in part[0].get('source', '')
        style = ':x' if published else '-o'
        label = f'{name}, published' if published else name
        axes.plot([row[against] for row in part], [r['correct'] for r in part], style, label=label)
    axes.axhline(rows[0]['regions'], color='grey', linestyle='--', label='regions in the set')
    axes.set_xlabel(against)
    axes.set_ylabel('correct regions per image')
    axes.grid(alpha=0.3)
    figure.legend(fontsize=8, loc='outside right upper')
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110)
