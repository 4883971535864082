"""Time, memory and energy of the segmenter on the frames of a camera."""

from __future__ import annotations

import hashlib
import json
import math
import multiprocessing
import re
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage, RangeImageError
from rangeseg_ros.digest import code_digest
from rangeseg_ros.io.corrections import corrected
from rangeseg_ros.io.files import replacing
from rangeseg_ros.io.images import read_depth

WARM_UP = 3
"""Frames segmented before the first that counts."""

Progress = Callable[[Iterable[Path], int], Iterable[Path]]


@dataclass(frozen=True)
class Frames:
    """Depth images of one camera.

    Attributes
    ----------
    paths : tuple of Path
        Files, at least one.
    camera : Camera
        Intrinsics of all of them.
    scale : float or None
        Metres per unit, as `RangeImage.from_depth` takes it.
    """

    paths: tuple[Path, ...]
    camera: Camera
    scale: float | None = None

    def image(self, path: Path, depth: NDArray) -> RangeImage:
        """Range image of the content `depth` of a file.

        Raises
        ------
        RangeImageError
            As `RangeImage.from_depth`, naming the file.
        """
        try:
            return RangeImage.from_depth(depth, self.camera, self.scale)
        except RangeImageError as error:
            raise RangeImageError(f'{path}: {error}') from None

    def read(self, path: Path) -> RangeImage:
        """Range image of a file; raises also what `read_depth` raises."""
        return self.image(path, read_depth(path))


def _silent(paths: Iterable[Path], total: int) -> Iterable[Path]:
    return paths


def measure(
    frames: Frames,
    config: Config,
    rounds: int = 3,
    progress: Progress = _silent,
    threads: int | None = None,
) -> dict[str, Any]:
    """Time and memory of the segmenter, in a process of its own.

    Parameters
    ----------
    frames : Frames
    config : Config
    rounds : int
        How many times all frames are segmented.
    progress : callable
        Shows the progress through the paths of so many frames; can be pickled.
    threads : int, optional
        At most so many; as many as OpenCV takes by itself when not given.

    Returns
    -------
    dict
        `stages` and `total`: `median_ms` and `p95_ms`, from the content of the file to the planes
        (stage `image` is the conversion to a range image), reading the file apart.
        `cpu_ms`: median processor time of a frame, summed over threads. `first_frame_ms`: the
        first in a process. `frames_per_second`: 1 / mean total.
        `peak_memory_mb`: of the process, Python and all libraries included; NaN where the
        system has no /proc. `frames`, `rounds`, `width`, `height`, `method`,
        `threads`.
    """
    # What numba has not compiled yet is compiled and cached here, not where it is measured.
    Segmenter(config).segment(corrected(frames.read(frames.paths[0]), config))
    with ProcessPoolExecutor(1, multiprocessing.get_context('spawn')) as pool:
        return pool.submit(_measure, frames, config, rounds, progress, threads).result()


def _measure(
    frames: Frames, config: Config, rounds: int, progress: Progress, threads: int | None
) -> dict[str, Any]:
    if threads:
        cv2.setNumThreads(threads)
    segmenter = Segmenter(config)
    order = (*frames.paths[:1] * WARM_UP, *frames.paths * rounds)
    laps = [_laps(segmenter, frames, path) for path in progress(order, len(order))]
    counted = laps[WARM_UP:]
    cpu = [lap.pop('cpu') for lap in counted]
    stages = {name: _figures([lap[name] for lap in counted]) for name in counted[0]}
    totals = [lap['total'] for lap in counted]
    return {
        'method': config.method,
        'threads': cv2.getNumThreads(),
        'width': frames.camera.width,
        'height': frames.camera.height,
        'frames': len(frames.paths),
        'rounds': rounds,
        'total': stages.pop('total'),
        'stages': stages,
        'cpu_ms': float(np.median(cpu)),
        'frames_per_second': 1000 / float(np.mean(totals)),
        'first_frame_ms': laps[0]['total'],
        'peak_memory_mb': peak_memory(),
    }


def _laps(segmenter: Segmenter, frames: Frames, path: Path) -> dict[str, float]:
    """Milliseconds of each stage of a frame, the total and the processor time."""
    depth = read_depth(path)
    begin, begin_cpu = time.perf_counter(), time.process_time()
    image = corrected(frames.image(path, depth), segmenter.config)
    converted = time.perf_counter()
    timings = segmenter.segment(image).timings
    end, end_cpu = time.perf_counter(), time.process_time()
    return {
        'image': 1000 * (converted - begin),
        **timings,
        'total': 1000 * (end - begin),
        'cpu': 1000 * (end_cpu - begin_cpu),
    }


def _figures(milliseconds: Sequence[float]) -> dict[str, float]:
    return {
        'median_ms': float(np.median(milliseconds)),
        'p95_ms': float(np.percentile(milliseconds, 95)),
    }


def peak_memory() -> float:
    """Largest resident memory of this process so far, MB (2^20 bytes); NaN without /proc."""
    # The maximum that getrusage knows includes that of the parent process before exec.
    try:
        status = Path('/proc/self/status').read_text()
    except OSError:
        return math.nan
    found = re.search(r'^VmHWM:\s*(\d+) kB', status, re.MULTILINE)
    return int(found[1]) / 1024 if found else math.nan


def energy_ratio(
    frames: Frames, config: Config, cache: Path, progress: Progress = _silent
) -> dict[str, float]:
    """Energy of the labellings against those of the exact minimisation.

    Parameters
    ----------
    frames : Frames
    config : Config
        Compared to itself with `exact`.
    cache : Path
        Folder of the exact energies: what is there is not computed again.
    progress : callable
        As for `measure`.

    Returns
    -------
    dict
        `median` and `worst` over the frames; below 1 where the exact run ends higher.
    """
    segmenter, exact = Segmenter(config), Segmenter(replace(config, exact=True))
    ratios = []
    for path in progress(frames.paths, len(frames.paths)):
        image = corrected(frames.read(path), config)
        energy, least = segmenter.segment(image).energy, _cached_energy(exact, image, cache)
        with np.errstate(divide='ignore'):
            ratios.append(1.0 if energy == least else float(np.divide(energy, least)))
    return {'median': float(np.median(ratios)), 'worst': max(ratios)}


def _cached_energy(segmenter: Segmenter, image: RangeImage, cache: Path) -> float:
    digest = hashlib.sha256(code_digest())
    digest.update(repr((asdict(segmenter.config), image.camera)).encode())
    digest.update(image.inverse.tobytes())
    path = cache / f'{digest.hexdigest()[:16]}.json'
    if path.exists():
        return float(json.loads(path.read_text()))
    energy = float(segmenter.segment(image).energy)
    with replacing(path) as partial:
        partial.write_text(json.dumps(energy))
    return energy


def table(figures: dict[str, Any]) -> str:
    """Text of what `measure` gives, with `energy_ratio` where there is one."""
    rows = [('stage', 'median ms', 'p95 ms')]
    for name, stage in (*figures['stages'].items(), ('total', figures['total'])):
        rows.append((name, f'{stage["median_ms"]:.1f}', f'{stage["p95_ms"]:.1f}'))
    lines = [f'{name:<20}{median:>12}{p95:>12}' for name, median, p95 in rows]
    single = [
        ('processor, ms', 'cpu_ms', '.1f'),
        ('frames per second', 'frames_per_second', '.1f'),
        ('first frame, ms', 'first_frame_ms', '.0f'),
        ('peak memory, MB', 'peak_memory_mb', '.0f'),
    ]
    lines += [f'{title:<20}{figures[key]:>12{form}}' for title, key, form in single]
    if 'energy_ratio' in figures:
        ratio = figures['energy_ratio']
        lines.append(f'energy / exact: median {ratio["median"]:.4f}, worst {ratio["worst"]:.4f}')
    return '\n'.join(lines)


def budget_table(series: dict[str, dict[str, Any]]) -> str:
    """Text of `measure` figures of several values of `work_budget`."""
    head = ('median ms', 'p95 ms', 'cpu ms')
    lines = [f'{"budget":<12}' + ''.join(f'{title:>11}' for title in head)]
    for budget, figures in series.items():
        total = figures['total']
        lines.append(
            f'{budget:<12}{total["median_ms"]:>11.1f}{total["p95_ms"]:>11.1f}'
            f'{figures["cpu_ms"]:>11.1f}'
        )
    return '\n'.join(lines)


def scaling_table(series: dict[str, dict[str, Any]]) -> str:
    """Text of `measure` figures of several sizes of image, each with its `ratio`."""
    head = ('median ms', 'p95 ms', 'ratio', 'cpu ms', 'peak MB')
    lines = [f'{"size":<12}' + ''.join(f'{title:>11}' for title in head)]
    for size, figures in series.items():
        total = figures['total']
        lines.append(
            f'{size:<12}{total["median_ms"]:>11.1f}{total["p95_ms"]:>11.1f}'
            f'{figures["ratio"]:>11.2f}{figures["cpu_ms"]:>11.1f}{figures["peak_memory_mb"]:>11.0f}'
        )
    return '\n'.join(lines)
