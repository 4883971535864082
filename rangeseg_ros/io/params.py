"""Parameter files: YAML to Config."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rangeseg_ros.core.config import NAMES, Config
from rangeseg_ros.core.options import ConfigError, unknown_parameter
from rangeseg_ros.io.corrections import check_corrections
from rangeseg_ros.io.yaml_files import read_yaml

NODE = 'segment_planes'
OF_EVERY_NODE = 'use_sim_time', 'start_type_description_service'
# Parameters that the node has beyond those of the segmenter; nested ones by their first part.
NODE_ONLY = frozenset(
    {'input', 'raw', 'use_imu', 'managed', 'target_rate', 'stall_timeout', 'qos_overrides'}
    | set(OF_EVERY_NODE)
)


def read_params(path: Path) -> dict[str, Any]:
    """Read the parameters of the segmenter from a YAML file, without `NODE_ONLY`.

    It has names and values, or is a ROS parameter file: of that, the sections of the node
    `segment_planes` in any namespace and of the wildcards `/**` and `/*` count. A section of a
    wildcard may be for other nodes as well: what it has for them is left out with a UserWarning.
    FileError or ConfigError: a file that cannot be read, or has no parameters.
    """
    content = read_yaml(path)
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f'{path}: not a mapping of parameter names to values')
    content = _without_node_only(content)
    if not any(isinstance(part, dict) for part in content.values()):
        return content
    sections = [part for part in _sections(path, content) if part[0] in (NODE, '*', '**')]
    if not sections:
        raise ConfigError(f'{path}: no ros__parameters of {NODE}')
    merged: dict[str, Any] = {}
    for node, section in sections:
        own = _without_node_only(section)
        foreign = [name for name in own if node != NODE and name not in NAMES]
        if foreign:
            listed = ', '.join(sorted(unknown_parameter(name, NAMES) for name in foreign))
            warnings.warn(f'{path}: {listed} (of another node?), ignored', stacklevel=2)
        merged.update({name: value for name, value in own.items() if name not in foreign})
    return merged


def names_of_node(path: Path, node: str) -> set[str]:
    """Parameters that a ROS parameter file has for a node by its name; none where it is broken."""
    try:
        sections = _sections(path, read_yaml(path) or {})
        return {str(name) for own, section in sections if own == node for name in section}
    except ValueError:
        return set()


def _sections(path: Path, content: dict[Any, Any]) -> Iterator[tuple[str, dict[Any, Any]]]:
    """Last part of the name of each node, which namespaces may surround, and its parameters."""
    for name, part in content.items():
        if not isinstance(part, dict):
            raise ConfigError(f'{path}: {name} has no ros__parameters')
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

    Errors as `read_params`; ConfigError also names an unknown parameter or a wrong value.
    """
    params = {} if path is None else read_params(path)
    try:
        config = Config.from_mapping({**params, **overrides})
        check_corrections(config)
    except ConfigError as error:
        raise ConfigError(f'{path}: {error}' if path else str(error)) from None
    return config
