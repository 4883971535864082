"""Parameter files: YAML to Config."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from rangeseg_ros.core.config import Config, ConfigError

NODE = 'segment_planes'
# Parameters that the node has beyond those of the segmenter; nested ones by their first part.
NODE_ONLY = frozenset(
    {'input', 'raw', 'use_imu', 'stall_timeout', 'qos_overrides', 'use_sim_time'}
)


def read_params(path: Path) -> dict[str, Any]:
    """Read the parameters of the segmenter from a YAML file.

    Parameters
    ----------
    path : Path
        Names and values, or a ROS parameter file: of that, the sections of the node
        `segment_planes` in any namespace and of the wildcard `/**`, without `NODE_ONLY`.

    Raises
    ------
    ConfigError
        A missing or unreadable file, or one without parameters.
    """
    try:
        content = yaml.safe_load(path.read_text())
    except OSError as error:
        raise ConfigError(f'{path}: {error.strerror}') from None
    except (UnicodeDecodeError, yaml.YAMLError):
        raise ConfigError(f'{path}: not a YAML file') from None
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f'{path}: not a mapping of parameter names to values')
    sections = {name: part for name, part in content.items() if isinstance(part, dict)}
    if not sections:
        return content
    merged: dict[str, Any] = {}
    for name, section in sections.items():
        if str(name).rpartition('/')[2] in (NODE, '**'):
            merged.update(section.get('ros__parameters') or {})
    if not merged:
        raise ConfigError(f'{path}: no ros__parameters of {NODE}')
    return {
        name: value
        for name, value in merged.items()
        if str(name).partition('.')[0] not in NODE_ONLY
    }


def read_config(path: Path | None, **overrides: Any) -> Config:
    """Build the Config of a parameter file (the defaults without one) and of `overrides`.

    Raises
    ------
    ConfigError
        As `read_params`; an unknown parameter or a value out of range, named in the message.
    """
    params = {} if path is None else read_params(path)
    try:
        return Config.from_mapping({**params, **overrides})
    except ConfigError as error:
        raise ConfigError(f'{path}: {error}' if path else str(error)) from None
