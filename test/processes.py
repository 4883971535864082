"""Programs in processes of their own."""

import subprocess
import sys
import time

RANGESEG = [sys.executable, '-c', 'from rangeseg_ros.cli.main import main; main()']


def python(code, *arguments, **options):
    """Run code; the process that has ended, with what it printed."""
    command = [sys.executable, '-c', code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=500, **options)


def wait_for(condition, process=None):
    """The value of a condition once it holds, which comes before the end of a process."""
    end = time.monotonic() + 120
    while not (found := condition()):
        assert time.monotonic() < end
        assert process is None or process.poll() is None
        time.sleep(0.01)
    return found
