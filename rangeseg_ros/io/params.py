"""Parameter files: YAML to Config."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rangeseg_ros.core.config import Config, known_name
from rangeseg_ros.core.options import ConfigError
from rangeseg_ros.io.corrections import check_corrections
from rangeseg_ros.io.yaml_files import YamlError, read_yaml

NODE = 'segment_planes'
# Parameters that the node has beyond those of the segmenter; nested ones by their first part.
NODE_ONLY = frozenset(
    {'input', 'raw', 'use_imu', 'managed', 'target_rate', 'stall_timeout', 'qos_overrides'}
    | {'use_sim_time'}
)


def read_params(path: Path) -> dict[str, Any]:
    """Read the parameters of the segmenter from a YAML file.

    Parameters
    ----------
    path : Path
        Names and values, or a ROS parameter file: of that, the sections of the node
        `segment_planes` in any namespace and of the wildcards `/**` and `/*`, without `NODE_ONLY`.
        A section of a wildcard may be for other nodes as well.

    Raises
    ------
    ConfigError
        A missing or unreadable file, or one without parameters.

    Warns
    -----
    UserWarning
        A section of a wildcard has names that are none of the segmenter's: they are left out.
    """
    try:
        content = read_yaml(path)
    except YamlError as error:
        raise ConfigError(str(error)) from None
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f'{path}: not a mapping of parameter names to values')
    content = _without_node_only(content)
    if not any(isinstance(part, dict) for part in content.values()):
        return content
    merged: dict[str, Any] = {}
    found = False
    for node, section in _sections(path, content):
        if node not in (NODE, '*', '**'):
            continue
        found = True
        own = _without_node_only(section)
        if node != NODE:
            foreign = sorted(str(name) for name in own if not known_name(name))
            if foreign:
                warnings.warn(f'{path}: left out {", ".join(foreign)}', stacklevel=2)
            own = {name: value for name, value in own.items() if known_name(name)}
        merged.update(own)
    if not found:
        raise ConfigError(f'{path}: no ros__parameters of {NODE}')
    return merged


def _sections(path: Path, content: dict[Any, Any]) -> Iterator[tuple[str, dict[Any, Any]]]:
    """Last part of the name of each node, which namespaces may surround, and its parameters."""
    for name, part in content.items():
        if not isinstance(part, dict):
            raise ConfigError(f'{path}: {name} is no section with ros__parameters')
        if 'ros__parameters' not in part:
            yield from _sections(path, part)
            continue
        section = part['ros__parameters']
        if not isinstance(section, dict | type(None)):
            raise ConfigError(f'{path}: ros__parameters of {name} is no mapping')
        yield str(name).rpartition('/')[2], section or {}


def _without_node_only(section: dict[Any, Any]) -> dict[Any, Any]:
    return {
        name: value
        for name, value in section.items()
        if str(name).partition('.')[0] not in NODE_ONLY
    }


def read_config(path: Path | None, **overrides: Any) -> Config:
    """Build the Config of a parameter file (the defaults without one) and of `overrides`.

    Raises
    ------
    ConfigError
        As `read_params`; an unknown parameter, a value out of range or a file that cannot be
        read, named in the message.
    """
    params = {} if path is None else read_params(path)
    try:
        config = Config.from_mapping({**params, **overrides})
        check_corrections(config)
    except ConfigError as error:
        raise ConfigError(f'{path}: {error}' if path else str(error)) from None
    return config
