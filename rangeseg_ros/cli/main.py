"""The `rangeseg` command: one module of this package per subcommand."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec

import click

COMMANDS = (
    'segment',
    'pack',
    'replay',
    'simulate',
    'evaluate',
    'compare',
    'experiment',
    'bench',
    'play',
    'view',
)


class _LazyGroup(click.Group):
    """Imports a subcommand's module only when it is asked for: `--help` stays quick."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [name for name in COMMANDS if find_spec(f'rangeseg_ros.cli.{name}')]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self.list_commands(ctx):
            return None
        command: click.Command = import_module(f'rangeseg_ros.cli.{cmd_name}').command
        return command


@click.group(cls=_LazyGroup, context_settings={'help_option_names': ['-h', '--help']})
@click.version_option(package_name='rangeseg_ros')
def rangeseg() -> None:
    """Segment depth images into planes."""


def main() -> None:
    """Run the command line; bad input ends with exit code 2 and one line that says why."""
    try:
        # Without its standalone mode click returns the code that a command exits with.
        sys.exit(rangeseg.main(prog_name='rangeseg', standalone_mode=False))
    except click.ClickException as error:
        print(f'rangeseg: {error.format_message()}', file=sys.stderr)
        sys.exit(2)
    except (ValueError, OSError) as error:
        print(f'rangeseg: {error}', file=sys.stderr)
        sys.exit(2)
    except (KeyboardInterrupt, click.Abort):
        sys.exit(130)
