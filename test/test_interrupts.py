"""Ctrl-C ends commands, whatever becomes of the exception it raises."""

import subprocess
import sys
from textwrap import dedent

import pytest

PRELUDE = """
    import ctypes, os, signal, threading
    import click
    from rangeseg_ros.cli import main, options
    def loop():
        for item in options.progress(range(3), 3, 'item'):
            print(item, flush=True)
            BODY
    main.rangeseg = click.Command('rangeseg', callback=loop)
    main.main()
"""
LOST = """try: os.kill(os.getpid(), signal.SIGINT); sum(range(9))
            except KeyboardInterrupt: pass"""
WRAPPED = """try: os.kill(os.getpid(), signal.SIGINT); sum(range(9))
            except KeyboardInterrupt as error: raise SystemError('in a kernel') from error"""
MISTAKEN = """try: os.kill(os.getpid(), signal.SIGINT); sum(range(9))
            except KeyboardInterrupt: raise ValueError('not a bag')"""
IN_A_CALLBACK = """ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), signal.SIGINT))()"""
BESIDE_A_THREAD_THAT_WAITS = """threading.Thread(target=threading.Event().wait).start()
            os.kill(os.getpid(), signal.SIGINT)"""
NONE = "raise SystemError('without a reason')"


def run(body):
    script = dedent(PRELUDE.replace('BODY', body))
    return subprocess.run(
        [sys.executable, '-c', script], capture_output=True, text=True, timeout=60, check=False
    )


@pytest.mark.parametrize(
    ('body', 'name', 'code'),
    [
        (LOST, 'SIGINT', 130),
        (WRAPPED, 'SIGINT', 130),
        (MISTAKEN, 'SIGTERM', 143),
        (IN_A_CALLBACK, 'SIGTERM', 143),
        (LOST, 'SIGHUP', 129),
        (BESIDE_A_THREAD_THAT_WAITS, 'SIGINT', 130),
    ],
)
def test_a_signal_ends_the_command(body, name, code):
    done = run(body.replace('SIGINT', name).replace('KeyboardInterrupt', 'BaseException'))
    assert (done.returncode, done.stdout, done.stderr.strip()) == (code, '0\n', '')


def test_who_ignores_interrupts_still_does():
    body = 'os.kill(os.getpid(), signal.SIGINT)'
    script = dedent(PRELUDE.replace('BODY', body)).strip()
    done = subprocess.run(
        ['sh', '-c', 'trap "" INT; exec "$0" -c "$1"', sys.executable, script],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, '0\n1\n2\n')


def test_other_system_errors_are_shown():
    done = run(NONE)
    assert done.returncode == 1 and 'without a reason' in done.stderr
