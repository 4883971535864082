"""Named tuples of kernels, while signal handlers raise."""

import subprocess
import sys

CODE = """
import signal
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rangeseg_ros.core.runtime.boxing import box_safely

box_safely()


class Inner(NamedTuple):
    a: float
    b: NDArray[np.float64]


class Outer(NamedTuple):
    inner: Inner
    c: int


@njit
def kernel(x):
    return Outer(Inner(x, np.ones(3)), 1)


class Raised(Exception):
    pass


armed = False


def on_alarm(*_):
    global armed
    if armed:
        armed = False
        raise Raised


whole = kernel(2.0)
assert type(whole) is Outer and whole.inner.a == 2 and (whole.inner.b == 1).all()
signal.signal(signal.SIGALRM, on_alarm)
signal.setitimer(signal.ITIMER_REAL, 2e-4, 2e-4)
raised = 0
while raised < 2000:
    try:
        armed = True
        kernel(1.0)
        armed = False
    except (Raised, SystemError):
        raised += 1
signal.setitimer(signal.ITIMER_REAL, 0)
"""


def test_an_exception_of_a_signal_handler_comes_through():
    done = subprocess.run([sys.executable, '-c', CODE], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, '')
