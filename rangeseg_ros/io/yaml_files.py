"""YAML and JSON files that people write, with limits on their size and nesting."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from rangeseg_ros.io.files import FileError, read_bytes

LARGEST = 2**17
"""Largest file, bytes: a hundred times what calibrations and parameters have."""


class _Loader(yaml.SafeLoader):
    """Refuses content that aliases make larger than the largest file."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> Any:
        node: Any = super().compose_node(parent, index)
        if not hasattr(node, 'size'):
            parts: list[Any] = node.value if isinstance(node, yaml.CollectionNode) else []
            pairs = [part if isinstance(part, tuple) else (part,) for part in parts]
            node.size = 1 + sum(each.size for pair in pairs for each in pair)
            if node.size > LARGEST:
                raise RecursionError
        return node


def read_yaml(path: Path) -> Any:
    """Content of a YAML file, or of a JSON file that is called *.json.

    FileError: it cannot be read, is no YAML, too large or too deep.
    """
    data, json_file = read_bytes(path, LARGEST), path.suffix == '.json'
    try:
        # JSON may be indented by tabs, YAML may not.
        return json.loads(data) if json_file else yaml.load(data, _Loader)
    except RecursionError:
        raise FileError(f'{path}: nested too deeply or too often') from None
    # Not of YAML alone: dates and numbers raise errors of Python.
    except (ValueError, OverflowError, yaml.YAMLError) as error:
        mark = getattr(error, 'problem_mark', None)
        where = f' from line {mark.line + 1} on' if mark else ''
        raise FileError(f'{path}: not a {"JSON" if json_file else "YAML"} file{where}') from None
