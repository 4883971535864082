"""The report of a replay: what was found in a recording, frame by frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.sensing.sensor import SensorModel
from rangeseg_ros.report import charts
from rangeseg_ros.report.page import Picture, evenly_spaced, write_page


class ReplayReport:
    """Collects the frames of a recording and writes their page.

    `reasons` counts why frames have no planes.
    """

    def __init__(self, name: str, config: Config) -> None:
        self.name = name
        self.config = config
        self.reasons: Counter[str] = Counter()
        self._stamps: list[int] = []
        self._sightings = [np.empty(0, charts.SIGHTING)]
        self._timings: list[dict[str, float]] = []
        self._pictures: list[Picture] = []
        self._sensors: list[SensorModel] = []

    @property
    def frames(self) -> int:
        """Number of frames so far."""
        return len(self._stamps)

    def add(self, stamp: int, result: Segmentation, picture: Path) -> None:
        """Add the next frame, taken at `stamp` nanoseconds; `picture` is its overlay's file."""
        rows = [(self.frames, p.id, p.area, p.distance, p.normal) for p in result.planes]
        self._sightings.append(np.array(rows, charts.SIGHTING))
        found = f'{len(result.planes)} planes' if result.planes else result.reason
        self._pictures.append(Picture(picture, f'frame {self.frames}: {found}'))
        self._stamps.append(stamp)
        self._timings.append(result.timings)
        self._sensors.append(result.sensor)
        if not result.planes:
            self.reasons[result.reason] += 1

    def figures(self) -> dict[str, float]:
        """`duration` in seconds, median number of `planes_per_frame`, and number of `ids`."""
        sightings = np.concatenate(self._sightings)
        per_frame = np.bincount(sightings['frame'], minlength=self.frames)
        return {
            'duration': (self._stamps[-1] - self._stamps[0]) / 1e9 if self.frames else 0.0,
            'planes_per_frame': float(np.median(per_frame)) if self.frames else 0.0,
            'ids': len(np.unique(sightings['id'])),
        }

    def write(self, path: Path, damage: str = '', doubts: Sequence[str] = ()) -> None:
        """Write the page.

        `damage` tells what of the recording could not be read, `doubts` what the planes say
        against the poses.
        """
        sightings = np.concatenate(self._sightings)
        times = (np.array(self._stamps) - self._stamps[0]) / 1e9 if self._stamps else np.empty(0)
        sensor = SensorModel(*np.median(self._sensors, axis=0)) if self._sensors else ''
        names = dict.fromkeys(name for laps in self._timings for name in laps)
        # 0 where a frame has not come to the stage.
        stages = {n: np.array([laps.get(n, 0.0) for laps in self._timings]) for n in names}
        if stages:
            stages['total'] = np.sum(list(stages.values()), axis=0)
        write_page(
            path,
            'replay.html',
            name=self.name,
            damage=damage,
            doubts=doubts,
            frames=self.frames,
            sensor=sensor,
            **self.figures(),
            pictures=evenly_spaced(self._pictures),
            limits=(charts.MAX_BARS, charts.MAX_LINES),
            id_bars=charts.id_bars(sightings, times) if len(sightings) else '',
            drifts=charts.drifts(sightings, times) if len(sightings) else '',
            stages=[
                (name, np.median(times), np.percentile(times, 95), times.max())
                for name, times in stages.items()
            ],
            reasons=self.reasons.most_common(),
            parameters=[
                (option.name, getattr(self.config, option.name), option.default, option.metadata)
                for option in fields(Config)
            ],
        )


def write_overview(path: Path, name: str, recordings: Sequence[Mapping[str, Any]]) -> None:
    """Write the page that leads to the reports of several recordings, in folders beside it.

    Each has the `name` of its folder, the number of its `frames` and of those that are `empty`,
    its `damage`, whether it `failed`, and what `ReplayReport.figures` returns.
    """
    write_page(path, 'overview.html', name=name, recordings=recordings)
