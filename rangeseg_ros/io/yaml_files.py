"""YAML and JSON files that people write: small, and not made to be read for ever."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from rangeseg_ros.io.files import FileError, read_bytes

LARGEST = 2**20
"""Bytes; of calibrations and parameters a thousand times what they have."""


def read_yaml(path: Path) -> Any:
    """Content of a YAML file, or of a JSON file that is called *.json.

    FileError: it cannot be read, is no YAML, too large or too deep.
    """
    # JSON may be indented by tabs, YAML may not.
    parse, kind = (json.loads, 'JSON') if path.suffix == '.json' else (yaml.safe_load, 'YAML')
    data = read_bytes(path, LARGEST)
    try:
        return parse(data.decode())
    except RecursionError:
        raise FileError(f'{path}: nested too deeply') from None
    # Not of YAML alone: dates and numbers raise errors of Python.
    except (ValueError, OverflowError, yaml.YAMLError):
        raise FileError(f'{path}: not a {kind} file') from None
