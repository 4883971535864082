"""`rangeseg compile`: kernels compiled ahead of the first frame."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import click

from rangeseg_ros.cli import options
from rangeseg_ros.compilation.preparation import prepare
from rangeseg_ros.core.config import Config
from rangeseg_ros.io.params import read_config


@click.command()
@options.params
def command(params_file: Path | None) -> None:
    """Compile what the segmenter needs, so that no start has to.

    For images of containers and for CI: as the user who may write to the package, or with
    NUMBA_CACHE_DIR set here and where it runs. Compiles for images and clouds, without --params
    for both methods with their default parameters.
    """
    # Files of one sensor are read where it is, which need not be here.
    config = read_config(params_file, mask='', distortion_map='')
    methods = Config.__dataclass_fields__['method'].metadata['choices']
    configs = [config] if params_file else [replace(config, method=name) for name in methods]
    for each in configs:
        start = time.monotonic()
        prepare(each, report=click.echo)
        click.echo(f'method {each.method}: ready in {time.monotonic() - start:.1f} s')
