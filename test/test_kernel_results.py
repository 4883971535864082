"""What kernels return to Python, so that exceptions of signal handlers come through.

Of a named tuple the compiled code makes an object by calls of Python, in which signal handlers
run. Where one raises, as that of Ctrl-C does, Python 3.12 and later crash.
"""

import subprocess
import sys
from functools import partial
from importlib import import_module
from multiprocessing import get_context

import pytest
from numba import types

from rangeseg_ros import Config
from rangeseg_ros.compilation.discovery import discover
from rangeseg_ros.compilation.rehearsal import rehearse

CODE = """
import re
import signal

import numpy as np
from numba import njit


class Raised(Exception):
    pass


# What numba and NumPy make of it where it comes while arrays are handed over.
LOST = re.compile('returned a result with an exception set|subtype is NULL')


@njit
def nested(x):
    return (x, np.ones(3)), np.ones((2, 2), np.int32), 1


@njit
def array(x):
    return np.full(3, x)


def on_alarm(*_):
    global armed
    if armed:
        armed = False
        raise Raised


armed = False
(x, ones), more, one = nested(2.0)
assert (x, one) == (2, 1) and (ones == 1).all() and (more == 1).all() and (array(2.0) == 2).all()
signal.signal(signal.SIGALRM, on_alarm)
signal.setitimer(signal.ITIMER_REAL, 2e-4, 2e-4)
raised = 0
while raised < 4000:
    try:
        armed = True
        nested(1.0)
        array(1.0)
        armed = False
    except (Raised, SystemError, ValueError) as error:
        assert isinstance(error, Raised) or LOST.search(str(error)), error
        raised += 1
signal.setitimer(signal.ITIMER_REAL, 0)
"""


def named(kind):
    """Whether values of a type of numba's contain a named tuple."""
    if isinstance(kind, types.Optional):
        return named(kind.type)
    if not isinstance(kind, types.BaseTuple):
        return False
    return isinstance(kind, types.BaseNamedTuple) or any(map(named, kind))


@pytest.mark.parametrize('method', ['planes', 'normals'])
def test_no_kernel_returns_a_named_tuple_to_python(method):
    config = Config(method=method)
    rehearse(config)
    with get_context('spawn').Pool(1) as pool:
        called = pool.apply(discover, (partial(rehearse, config),))
    assert called
    for kernel in called:
        dispatcher = getattr(import_module(kernel.module), kernel.name)
        compiled = dispatcher.overloads[kernel.signature]
        assert not named(compiled.signature.return_type), kernel.name


def test_exceptions_of_signal_handlers_come_through_what_kernels_return():
    done = subprocess.run([sys.executable, '-c', CODE], capture_output=True, text=True)
    # Where a collection of garbage comes upon one it prints it (see `interrupts.silence_losses`).
    assert done.returncode == 0, done.stderr
