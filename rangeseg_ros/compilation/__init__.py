"""Kernels compiled ahead of the first frame, by several processes.

With this package imported, a frame that needs kernels which are not compiled has them compiled so.
"""

from rangeseg_ros.core.config import Config
from rangeseg_ros.core.runtime.kernels import compile_ahead_by


def _compile_ahead(config: Config, cloud: bool) -> None:
    # Imported when needed: it takes as long as the rest of the package.
    from rangeseg_ros.compilation.preparation import prepare, show

    prepare(config, ('points' if cloud else 'image',), show, ())


compile_ahead_by(_compile_ahead)
