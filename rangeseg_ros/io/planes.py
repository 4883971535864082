"""Tables of planes: CSV, one row per plane."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import fields
from itertools import combinations_with_replacement
from operator import attrgetter, itemgetter
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.mapping.map_planes import MapPlane
from rangeseg_ros.io.files import replacing


def _axes(field: str, axes: str) -> dict[str, Callable[[Any], Any]]:
    return {f'{field}_{axis}': itemgetter(index) for index, axis in enumerate(axes)}


def _entries(attribute: str, names: Sequence[str]) -> dict[str, Callable[[Any], Any]]:
    """Columns of an attribute, an array, of the field."""

    def entry(k: int) -> Callable[[Any], Any]:
        return lambda value: getattr(value, attribute)[k]

    return {name: entry(k) for k, name in enumerate(names)}


def _points(points: NDArray) -> str:
    return ';'.join(' '.join(f'{x:.6g}' for x in point) for point in points)


# Columns of the fields that are no single value; the covariance is symmetric.
_PARTS: dict[str, dict[str, Callable[[Any], Any]]] = {
    'normal': _axes('normal', 'xyz'),
    'centroid': _axes('centroid', 'xyz'),
    'covariance': {
        f'covariance_{"xyzd"[i]}{"xyzd"[j]}': itemgetter((i, j))
        for i, j in combinations_with_replacement(range(4), 2)
    },
    'shape': {
        'area': attrgetter('area'),
        **_entries('extents', ('length', 'width')),
        **_entries('centre', ('centre_x', 'centre_y', 'centre_z')),
        **_entries('orientation', [f'orientation_{axis}' for axis in 'xyzw']),
    },
    'outline': {
        'hull': lambda outline: _points(outline.hull),
        'holes': lambda outline: '|'.join(map(_points, outline.holes)),
    },
}


def columns(kind: type[Plane] = Plane, without: Collection[str] = ()) -> list[str]:
    """Names of the columns, in the order of the fields of `kind`.

    `covariance_xd` is that of normal_x and distance. Outlines are points 'x y z' joined by ';',
    holes are joined by '|'.
    """
    names = [field.name for field in fields(kind) if field.name not in without]
    return [column for name in names for column in _PARTS.get(name, (name,))]


def row(plane: Plane, without: Collection[str] = ()) -> list[str]:
    """Values of `plane` for `columns`, as text."""
    return [_text(value) for value in values(plane, without)]


def values(plane: Plane, without: Collection[str] = ()) -> list[Any]:
    """Values of `plane` for `columns` as they are."""
    found: list[Any] = []
    for field in fields(plane):
        if field.name not in without:
            value = getattr(plane, field.name)
            parts = _PARTS.get(field.name)
            found += [part(value) for part in parts.values()] if parts else [value]
    return found


def write_map(path: Path, planes: Sequence[MapPlane]) -> None:
    """Write the planes of a map: the columns of `Plane` but the label, and those of `MapPlane`."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator='\n')
    table.writerow(columns(MapPlane, ('label',)))
    table.writerows(row(plane, ('label',)) for plane in planes)
    with replacing(path) as partial:
        partial.write_text(text.getvalue())


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
        self._append([[*leading, *columns()]])

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
        self._append([*leading, *row(plane)] for plane in planes)

    def _append(self, rows: Iterable[Sequence[object]]) -> None:
        # In one piece, so that an interruption does not cut it.
        text = io.StringIO()
        csv.writer(text, lineterminator='\n').writerows(rows)
        self._file.write(text.getvalue())
        self._file.flush()


def _text(value: Any) -> str:
    return f'{value:.9g}' if isinstance(value, float | np.floating) else str(value)
