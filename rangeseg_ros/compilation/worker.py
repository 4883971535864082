"""A process that compiles what frames need, by processes of its own.

It reads the pickled arguments of `rehearse`, and writes a line with the numbers of kernels that
are done and of all after each. It ends with whoever reads these.
"""

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path

from rangeseg_ros.compilation.discovery import Kernel, discover
from rangeseg_ros.compilation.rehearsal import rehearse
from rangeseg_ros.core.runtime import cache

_MOST_PROCESSES = 4


def main() -> None:
    """Compile all kernels that are not in the cache."""
    # What anything prints must not come between the answers.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), 'w')
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    rehearsed = partial(rehearse, *pickle.load(sys.stdin.buffer))
    # Those of a fork have imported all there is, and share its memory.
    context = get_context('fork')
    with _alone():
        with context.Pool(1) as pool:
            kernels = pool.apply(discover, (rehearsed,))
        with context.Pool(min(_MOST_PROCESSES, len(os.sched_getaffinity(0)))) as pool:
            for done, _ in enumerate(pool.imap_unordered(_compile, kernels), 1):
                print(done, len(kernels), file=answers, flush=True)


def _compile(kernel: Kernel) -> None:
    getattr(import_module(kernel.module), kernel.name).compile(kernel.signature)


@contextmanager
def _alone() -> Iterator[None]:
    """While no other process compiles for the same folder: the second then finds all done."""
    import fcntl

    folder = os.environ.get('NUMBA_CACHE_DIR') or cache.PACKAGE / 'core' / '__pycache__'
    with Path(folder, 'compiling.lock').open('w') as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


if __name__ == '__main__':
    try:
        main()
    except BrokenPipeError:  # nobody reads any more
        os._exit(1)
