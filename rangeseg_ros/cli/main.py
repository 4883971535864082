"""The `rangeseg` command: one module of this package per subcommand."""

from __future__ import annotations

import difflib
import os
import sys
import warnings
from importlib import import_module
from typing import Any

import click

from rangeseg_ros import interrupts
from rangeseg_ros.cli.errors import one_line
from rangeseg_ros.extras import MissingExtraError

# Of the input, of the machine or of the installation.
_EXPECTED = (
    *(click.ClickException, ValueError, OSError, MemoryError, RecursionError),
    *(MissingExtraError, ModuleNotFoundError),
)
# A subcommand's module is imported when it runs: help need not wait for all of them.
COMMANDS = {
    'segment': 'Segment depth images into planes.',
    'pack': 'Pack depth images into a rosbag2.',
    'mount': 'Find how a camera is mounted above the floor.',
    'replay': 'Segment the depth images of recordings.',
    'plan': 'Make floor plans and maps of recordings.',
    'simulate': 'Simulate range images with ground truth.',
    'calibrate': "Learn a sensor's distortion from the planes it sees.",
    'evaluate': 'Segment images and compare the results with their truth.',
    'compare': 'Compare label images with ground truth.',
    'bench': 'Measure the time and memory of each stage.',
    'compile': 'Compile ahead of the first frame.',
    'play': 'Publish the messages of a recording in ROS 2.',
}


class _LazyGroup(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            similar = difflib.get_close_matches(cmd_name, COMMANDS, 1, 0.4)
            hint = f': is {similar[0]!r} meant?' if similar else ' (rangeseg --help lists them)'
            if ctx.resilient_parsing:
                return None
            raise click.UsageError(f'no command {cmd_name!r}{hint}')
        command: click.Command = import_module(f'rangeseg_ros.cli.{cmd_name}').command
        return command

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        # Without a command, print the help and do not fail.
        return super().parse_args(ctx, args if args not in ([], ['help']) else ['--help'])

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section('Commands'):
            formatter.write_dl(list(COMMANDS.items()))


@click.group(cls=_LazyGroup, context_settings={'help_option_names': ['-h', '--help']})
@click.version_option(package_name='rangeseg_ros')
def rangeseg() -> None:
    """Segment depth images into planes."""


def _warn(message: Warning | str, *where: Any, **more: Any) -> None:
    text = one_line(message) if isinstance(message, Warning) else message
    print(f'rangeseg: warning: {text}', file=sys.stderr)


def main() -> None:
    """Run the command line; bad input ends with exit code 2 and one line that says why."""
    interrupts.watch()
    # This command prints errors itself, in one line.
    os.environ.setdefault('OPENCV_LOG_LEVEL', 'SILENT')
    warnings.showwarning = _warn
    try:
        # Without its standalone mode click returns the code that a command exits with.
        sys.exit(rangeseg.main(prog_name='rangeseg', standalone_mode=False))
    except SystemExit as end:
        if end.code and end.code == interrupts.exit_code():
            interrupts.end()
        raise
    except BaseException as error:
        # Libraries may turn the exception of a signal into an error of their own.
        if interrupts.exit_code():
            interrupts.end()
        if isinstance(error, (KeyboardInterrupt, click.Abort)):
            sys.exit(130)
        if not isinstance(error, _EXPECTED):
            raise
        usage = error.format_message() if isinstance(error, click.ClickException) else None
        print(f'rangeseg: {usage or one_line(error)}', file=sys.stderr)
        sys.exit(2)
