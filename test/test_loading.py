"""Loading compiled kernels: unparsed until others are compiled that call them."""

import subprocess
import sys

KERNELS = """
from numba import njit

@njit(cache=True)
def twice(x):
    return 2 * x

@njit(cache=True)
def shifted(x):
    return twice(x) + 1
"""

COUNT = """
from llvmlite import binding
parsed, parse = [], binding.parse_bitcode
binding.parse_bitcode = lambda code: parsed.append(code) or parse(code)
"""

LAZY = 'from rangeseg_ros.core.runtime.kernels import load_lazily\nload_lazily()\n'


def run(folder, code):
    """What `code` prints in a process of its own with the kernels at hand."""
    command = [sys.executable, '-c', code]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_bitcode_is_parsed_only_for_what_is_compiled(tmp_path):
    (tmp_path / 'kernels.py').write_text(KERNELS)
    call = 'from kernels import *\nprint(twice(3), len(parsed))\n'
    assert run(tmp_path, LAZY + COUNT + call) == ['6', '0']
    # From the cache; then as a part of a kernel that is compiled.
    assert run(tmp_path, COUNT + call) == ['6', '1']
    more = 'print(shifted(3), len(parsed))'
    assert run(tmp_path, LAZY + COUNT + call + more) == ['6', '0', '7', '1']
    # Both from the cache, whoever has compiled them.
    assert run(tmp_path, LAZY + COUNT + call + more) == ['6', '0', '7', '0']
    assert run(tmp_path, call.replace(', len(parsed)', '') + 'print(shifted(4))') == ['6', '9']
