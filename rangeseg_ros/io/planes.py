"""Tables of planes: CSV, one row per plane."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from rangeseg_ros.core.planes import Plane

# Columns of the fields that are no single value; the covariance is symmetric.
_PARTS: dict[str, dict[str, Any]] = {
    'normal': {'normal_x': 0, 'normal_y': 1, 'normal_z': 2},
    'centroid': {'centroid_x': 0, 'centroid_y': 1, 'centroid_z': 2},
    'covariance': {
        f'covariance_{row}{column}': ('xyzd'.index(row), 'xyzd'.index(column))
        for index, row in enumerate('xyzd')
        for column in 'xyzd'[index:]
    },
}


def columns() -> list[str]:
    """Names of the columns, in the order of the fields of `Plane`.

    `covariance_xd` is that of normal_x and distance. The hull is one column of points
    'x y z' joined by ';'.
    """
    return [column for field in fields(Plane) for column in _PARTS.get(field.name, (field.name,))]


def row(plane: Plane) -> list[str]:
    """Values of `plane` for `columns`."""
    return [_text(value) for value in _values(plane)]


class PlaneTable:
    """Writes planes row by row; each call is on disk when it returns.

    Parameters
    ----------
    path : Path
        File to write.
    leading : sequence of str
        Names of columns before those of the plane, e.g. frame and stamp.
    """

    def __init__(self, path: Path, leading: Sequence[str] = ()) -> None:
        self._file = path.open('w', newline='')
        self._writer = csv.writer(self._file, lineterminator='\n')
        self._writer.writerow([*leading, *columns()])
        self._file.flush()

    def __enter__(self) -> PlaneTable:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def write(self, planes: Sequence[Plane], *leading: object) -> None:
        """Append `planes`, with the values of the leading columns in each row."""
        self._writer.writerows([*leading, *row(plane)] for plane in planes)
        self._file.flush()


def _values(plane: Plane) -> Iterator[Any]:
    for field in fields(Plane):
        value = getattr(plane, field.name)
        if field.name in _PARTS:
            yield from (np.asarray(value)[index] for index in _PARTS[field.name].values())
        else:
            yield value


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return ';'.join(' '.join(f'{x:.6g}' for x in point) for point in value)
    return f'{value:.9g}' if isinstance(value, float | np.floating) else str(value)
