"""Kernels that do not count references to arrays."""

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError
from numba.core.runtime import _nrt_python, rtsys

from rangeseg_ros.core.runtime.references import UNCOUNTED


@njit(**UNCOUNTED)
def add_rows(values, total):
    for i in range(len(values)):
        row = values[i]
        for j in range(len(row)):
            total[j] += row[j]


@njit
def added(rows):
    values, total = np.ones((rows, 3)), np.zeros(3)
    add_rows(values, total)
    add_rows(values[1:], total)
    return total


def test_arrays_live_as_long_as_with_counts():
    _nrt_python.memsys_enable_stats()
    try:
        before = rtsys.get_allocation_stats()
        for rows in range(1, 50):
            assert (added(rows) == 2 * rows - 1).all()
        after = rtsys.get_allocation_stats()
    finally:
        _nrt_python.memsys_disable_stats()
    assert after.mi_alloc - before.mi_alloc == after.mi_free - before.mi_free > 0


@pytest.mark.parametrize('array', [lambda values: values[1:], lambda values: np.ones(3)])
def test_what_would_have_to_count_is_refused(array):
    with pytest.raises(TypingError):
        njit(**UNCOUNTED)(array)(np.ones(3))
