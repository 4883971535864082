"""Time and memory of the segmenter on the frames of a camera."""

from __future__ import annotations

import math
import multiprocessing
import re
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage, RangeImageError
from rangeseg_ros.io.corrections import corrected
from rangeseg_ros.io.images import read_depth

WARM_UP = 3
"""Frames segmented before the first that counts."""

Progress = Callable[[Iterable[Path], int], Iterable[Path]]


@dataclass(frozen=True)
class Frames:
    """Depth images of one camera, at least one; `scale` as `RangeImage.from_depth` takes it."""

    paths: tuple[Path, ...]
    camera: Camera
    scale: float | None = None

    def image(self, path: Path, depth: NDArray) -> RangeImage:
        """Range image of the content `depth` of a file, which RangeImageError names."""
        try:
            return RangeImage.from_depth(depth, self.camera, self.scale)
        except RangeImageError as error:
            raise RangeImageError(f'{path}: {error}') from None


def measure(
    frames: Frames, config: Config, rounds: int, progress: Progress, threads: int | None = None
) -> dict[str, Any]:
    """Time and memory of the segmenter, in a process of its own.

    All frames are segmented `rounds` times, with so many threads, or as many as OpenCV takes by
    itself; `progress`, which can be pickled, shows the way through the paths.

    The figures are `stages` and `total`: `median_ms` and `p95_ms`, from the content of the file to
    the planes (stage `image` is the conversion to a range image), reading the file apart;
    `cpu_ms`: median processor time of a frame, summed over threads; `first_frame_ms`: the first
    in a process; `frames_per_second`: 1 / mean total; `peak_memory_mb`: of the process, Python and
    all libraries included, NaN where the system has no /proc; `frames`, `rounds`, `width`,
    `height`, `method`, `threads`.
    """
    # What numba has not compiled yet is compiled and cached here, not where it is measured.
    first = frames.paths[0]
    Segmenter(config).segment(corrected(frames.image(first, read_depth(first)), config))
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
    stages = {}
    for name in counted[0]:
        median, high = np.percentile([lap[name] for lap in counted], [50, 95])
        stages[name] = {'median_ms': float(median), 'p95_ms': float(high)}
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


def peak_memory() -> float:
    """Largest resident memory of this process so far, MB (2^20 bytes); NaN without /proc."""
    # The maximum that getrusage knows includes that of the parent process before exec.
    try:
        status = Path('/proc/self/status').read_text()
    except OSError:
        return math.nan
    found = re.search(r'^VmHWM:\s*(\d+) kB', status, re.MULTILINE)
    return int(found[1]) / 1024 if found else math.nan


def table(figures: dict[str, Any]) -> str:
    """Text of what `measure` gives."""
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
    return '\n'.join(lines)
