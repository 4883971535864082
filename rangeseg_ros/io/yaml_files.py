"""YAML and JSON files that people write: small, and not made to be read for ever."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

LARGEST = 2**20
"""Bytes; of calibrations and parameters a thousand times what they have."""


class YamlError(ValueError):
    """A file that cannot be read as YAML."""


def read_yaml(path: Path) -> Any:
    """Content of a YAML file, or of a JSON file that is called *.json.

    Raises
    ------
    YamlError
        A missing file or one that cannot be read; no YAML; one that is too large or too deep.
    """
    # JSON may be indented by tabs, YAML may not.
    parse, kind = (json.loads, 'JSON') if path.suffix == '.json' else (yaml.safe_load, 'YAML')
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise YamlError(f'{path}: not a regular file')
        if size > LARGEST:
            raise YamlError(f'{path}: too large for such a file')
        content = parse(path.read_text())
    except OSError as error:
        raise YamlError(f'{path}: {error.strerror}') from None
    except RecursionError:
        raise YamlError(f'{path}: nested too deeply') from None
    except YamlError:
        raise
    # Not of YAML alone: dates and numbers raise errors of Python.
    except (ValueError, OverflowError, yaml.YAMLError):
        raise YamlError(f'{path}: not a {kind} file') from None
    return content
