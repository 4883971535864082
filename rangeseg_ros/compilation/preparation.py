"""Everything that a configuration needs compiled, by several processes, and loaded."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Collection
from dataclasses import astuple, replace
from typing import Any

from rangeseg_ros.compilation.rehearsal import KINDS, rehearse
from rangeseg_ros.core.config import Config
from rangeseg_ros.core.runtime.kernels import NotCompiledError, not_ahead, nothing_compiled
from rangeseg_ros.messages.outputs import OUTPUTS

Report = Callable[[str], None]
_BEGIN = 'compiling kernels'
_WIDTH = 30
# Of frames that have all that is compiled run, see `rehearse`. Exact ones take minutes if large:
# the least that takes the path of large frames.
_SIZE, _EXACT_SIZE = 10, 5


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
    """Compile all kernels that `config` needs for frames of `kinds`, and load them.

    Where they are compiled already, this takes as long as to load them, and `report` gets nothing;
    else the progress, 'compiling kernels, 12 of 35'. `outputs` are made of the frames.
    """
    size = _EXACT_SIZE if config.exact else _SIZE
    with not_ahead():
        try:
            with nothing_compiled():
                rehearse(config, kinds, outputs, size)
            return
        except NotCompiledError:
            pass
        report(_BEGIN)
        _compile(report, config, kinds, outputs)
        rehearse(config, kinds, outputs, size)


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

    What a process that breaks off leaves is compiled by its user.
    """
    # Of a group of its own, so that Ctrl-C is for the parent.
    worker = subprocess.Popen(
        [sys.executable, '-m', 'rangeseg_ros.compilation.worker'],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))},
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
        pass  # its user will meet the kernel itself, and say what is wrong with it
    except BaseException:
        os.killpg(worker.pid, signal.SIGTERM)
        raise
    finally:
        worker.stdout.close()
        worker.wait()
