"""Named tuples that kernels return, made so that Ctrl-C may come in between.

numba makes them by calls of Python, in which signal handlers run, and takes them for done: where a
handler has raised an exception it goes on with what is not there, and the process dies of it.
"""

from __future__ import annotations

from typing import Any

from numba.core import cgutils, types
from numba.core.boxing import box_tuple
from numba.core.pythonapi import _boxers


def box_safely() -> None:
    """Have numba look for exceptions in the kernels that are compiled from now on."""
    for kind in (types.NamedTuple, types.NamedUniTuple):
        _boxers.functions[kind] = _box


def _box(kind: Any, value: Any, c: Any) -> Any:
    """The object for a `value`, none where an exception was raised."""
    api, builder = c.pyapi, c.builder
    made = api.unserialize(api.serialize_object(kind.instance_class))
    fields = box_tuple(kind, value, c)
    result = cgutils.alloca_once_value(builder, api.get_null_object())
    raised = cgutils.is_not_null(builder, api.err_occurred())
    with builder.if_then(builder.not_(raised), likely=True):
        builder.store(api.call(made, fields), result)
    api.decref(made)
    api.decref(fields)
    return builder.load(result)
