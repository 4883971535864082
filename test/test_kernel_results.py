"""What kernels return to Python, so that exceptions of signal handlers come through.

Of a named tuple the compiled code makes an object by calls of Python, in which signal handlers
run. Where one raises, as that of Ctrl-C does, Python 3.12 and later crash.
"""

from functools import partial
from importlib import import_module
from multiprocessing import get_context

import pytest
from numba import types

from rangeseg_ros import Config
from rangeseg_ros.compilation.rehearsal import rehearse
from rangeseg_ros.compilation.worker import discover


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
