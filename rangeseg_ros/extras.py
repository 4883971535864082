"""Libraries that only some commands and functions need: the extra that brings each."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

EXTRAS = {
    'rosbags': 'bags',
    'ezdxf': 'plan',
    'jinja2': 'bags',
    'matplotlib': 'notebook',
    'pandas': 'notebook',
    'trimesh': 'notebook',
    'open3d': 'open3d',
    'OpenEXR': 'exr',
    'pypcd4': 'pcd',
    'distributed': 'dask',
    'rclpy': 'jazzy',
}
"""Package that is imported -> extra of setup.py."""


class MissingExtraError(ImportError):
    """A library of an extra that is not installed."""


def import_extra(name: str) -> ModuleType:
    """Import a library of `EXTRAS`.

    Raises
    ------
    MissingExtraError
        It is not installed; the message names the extra.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise MissingExtraError(install_command(error) or str(error)) from None


def install_command(error: ModuleNotFoundError) -> str:
    """The command that installs what is missing; empty where no extra brings it."""
    package = (error.name or '').partition('.')[0]
    if package not in EXTRAS:
        return ''
    return f"{package} is not installed: pip install 'rangeseg_ros[{EXTRAS[package]}]'"
