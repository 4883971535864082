"""Everything that a configuration needs compiled, by several processes, and loaded.

A rehearsal tells what it needs: the pipeline on frames as small as it takes to run through all
of it.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Collection, Iterator
from dataclasses import astuple, replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.runtime.kernels import compiled_by
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sequence import SequenceSegmenter
from rangeseg_ros.messages.outputs import OUTPUTS

KINDS = ('image', 'points')
"""Kinds of input whose kernels differ: depth images, and clouds."""

FIRST = ('labels', 'planes')
"""Outputs that need the fewest kernels: most listeners have no other."""

Report = Callable[[str], None]
_BEGIN = 'compiling kernels'
_WIDTH = 30
# Scale of the frames of `rehearse`. Exact solutions of large frames take minutes: they get the
# smallest scale that takes the path of large frames.
_SIZE, _EXACT_SIZE = 10, 5
# Metres at a metre. The second frame finds the planes of the first; many of the third are new.
_NOISE = (0.001, 0.001, 0.03)
_HEADER = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id='')


def needs(config: Config) -> tuple[Any, ...]:
    """What of `config` decides which kernels run: choices and switches, not how large values are.

    Of numbers whether they are zero, as that often switches something off; a smallest region of 0
    pixels only follows the size of the image.
    """
    values = astuple(replace(config, min_pixels=1))
    return tuple(v if isinstance(v, (str, bool)) else v == 0 for v in values)


def prepare(
    config: Config,
    kinds: tuple[str, ...] = KINDS,
    report: Report = print,
    outputs: Collection[str] = tuple(OUTPUTS),
) -> None:
    """Compile all kernels that `config` needs for frames of `kinds` and `outputs`, and load them.

    `report` gets the progress, 'compiling kernels, 12 of 35'; nothing where all is compiled, which
    takes as long as to load it.
    """
    size = _EXACT_SIZE if config.exact else _SIZE

    def ahead() -> None:
        report(_BEGIN)
        _compile(report, config, kinds, outputs)

    compiled_by(ahead, lambda: rehearse(config, kinds, outputs, size))


def show(progress: str) -> None:
    """Show on stderr how far it is: as a bar on a terminal, elsewhere that it begins."""
    if not sys.stderr.isatty():
        if progress == _BEGIN:
            print(f'rangeseg_ros: {progress}, once after the installation', file=sys.stderr)
        return
    counts = [int(word) for word in progress.split() if word.isdigit()] or [0, 1]
    bar = '#' * (_WIDTH * counts[0] // counts[1])
    end = '\n' if counts[0] == counts[1] else '\r'
    print(f'{progress:32} [{bar:{_WIDTH}}]', end=end, file=sys.stderr, flush=True)


def _compile(report: Report, *rehearsed: Any) -> None:
    """Fill the cache with what `rehearse(*rehearsed)` needs.

    What the worker leaves when it fails is compiled by the frame that calls it.
    """
    # Of this package, not of one in the current folder (Python 3.11), whose kernels are others.
    path = os.pathsep.join(filter(None, [*sys.path, str(Path(__file__).parents[2])]))
    # Of a group of its own, so that Ctrl-C is for the parent.
    worker = subprocess.Popen(
        [sys.executable, '-m', 'rangeseg_ros.compilation.worker'],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, 'PYTHONPATH': path, 'PYTHONSAFEPATH': '1'},
        start_new_session=True,
    )
    assert worker.stdin and worker.stdout
    try:
        worker.stdin.write(pickle.dumps(rehearsed))
        worker.stdin.close()
        for line in worker.stdout:
            done, count = line.split()
            report(f'{_BEGIN}, {done.decode()} of {count.decode()}')
    except BrokenPipeError:
        pass  # the frame that calls the kernel compiles it, and reports what is wrong
    except BaseException:
        os.killpg(worker.pid, signal.SIGTERM)
        raise
    finally:
        worker.stdout.close()
        worker.wait()


def rehearse(
    config: Config,
    kinds: tuple[str, ...] = KINDS,
    outputs: Collection[str] = tuple(OUTPUTS),
    size: int = 1,
) -> None:
    """Segment frames of each of `kinds` as `config` says, and make `outputs` of them.

    Frames of 64 x 48 pixels times `size`: small ones where kernels are interpreted, of 640 x 480,
    which take another path, where they are compiled.
    """
    # The room has a few hundred pixels per plane. Few directions: exact solutions with all of them
    # take minutes, and run the same kernels.
    config = replace(config, min_pixels=min(config.min_pixels, 50), direction_count=4)
    # What is measured in a small frame decides between paths; the stated sensor takes the other.
    stated = replace(config, sensor_model='fixed')
    for kind in kinds:
        for each, count in {stated: 1, config: len(_NOISE)}.items():
            sequence = SequenceSegmenter(each)
            for number, image in enumerate(islice(_frames(kind, size), count)):
                result = sequence.segment(image, number)
                for name in outputs:
                    OUTPUTS[name].message(_make, _HEADER, image, result)


def _frames(kind: str, size: int) -> Iterator[RangeImage]:
    camera = Camera(64 * size, 48 * size, 55.0 * size, 55.0 * size, 31.5 * size, 23.5 * size)
    for noise in _NOISE:
        image = RangeImage.from_depth(_room(noise, camera, size), camera)
        # From here on it is a cloud that no camera took.
        image = image if kind == 'image' else replace(image, camera=None)
        # Maps of distortion and masks are for images of another size.
        yield replace(image, corrected=True, body=np.zeros(image.shape, np.bool_))


def _room(noise: float, camera: Camera, size: int) -> NDArray[np.uint16]:
    """Depth (H, W), mm: walls and floor, a box and a ball before them, noise, holes."""
    x, y = camera.rays[..., 0], camera.rays[..., 1]
    depth = 2 / (1 + np.abs(x))
    depth = np.minimum(depth, np.where(y > 0.1, 0.6 / np.maximum(y, 0.1), np.inf))
    depth[24 * size : 40 * size, 8 * size : 24 * size] = 1.0
    ball = (x - 0.3) ** 2 + (y + 0.15) ** 2 < 0.03
    depth[ball] = 1.2 + 2 * ((x - 0.3) ** 2 + (y + 0.15) ** 2)[ball]
    depth = depth + noise * np.random.default_rng(0).normal(size=depth.shape) * depth**2
    depth[: 3 * size, 10 * size : 20 * size] = 0
    depth[30 * size : 30 * size + 4, 40 * size : 40 * size + 4] = 0
    # A bar that parts the left wall without touching it.
    depth[10 * size : 13 * size, : 28 * size] = 0.7
    millimetres: NDArray[np.uint16] = np.round(1000 * depth).astype(np.uint16)
    return millimetres


def _make(kind: str, **fields: Any) -> Any:
    """A message of nothing but its fields."""
    return SimpleNamespace(**fields)
