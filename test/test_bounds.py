"""Kernels read and write within their arrays, whatever comes."""

import os
import subprocess
import sys

import hard_inputs
import pytest


def results(**environment):
    run = subprocess.run(
        [sys.executable, hard_inputs.__file__],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
    )
    assert run.returncode == 0, run.stderr[-2000:]
    return run.stdout.splitlines()


@pytest.mark.slow
def test_checked_indices_change_nothing(pytestconfig):
    """With every index checked, no error comes, and all is the same bit for bit."""
    # Compiled kernels do not tell whether they check.
    kept = pytestconfig.cache.mkdir('checked_kernels')
    checked = results(NUMBA_BOUNDSCHECK='1', NUMBA_CACHE_DIR=os.fspath(kept))
    fast = results()
    assert len(fast) > 500
    assert not [line for line in checked if 'IndexError' in line]
    assert checked == fast
