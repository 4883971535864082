"""Declared options: defaults with description, range and choices; whether a value fits them."""

from __future__ import annotations

import difflib
import numbers
import reprlib
from collections.abc import Iterable
from dataclasses import field
from typing import Any

import numpy as np


class ConfigError(ValueError):
    """A parameter that does not exist, or a value outside its range."""


def option(
    default: bool | int | float | str,
    description: str,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare a `Config` field; `low` and `high` are inclusive."""
    metadata = {'description': description, 'low': low, 'high': high, 'choices': choices}
    return field(default=default, metadata=metadata)


def checked(option_field: Any, value: Any) -> Any:
    """Return `value` in the type of the field's default, or raise ConfigError."""
    name, kind = option_field.name, type(option_field.default)
    low, high, choices = (option_field.metadata[key] for key in ('low', 'high', 'choices'))
    shown = reprlib.repr(value)
    # Numbers of numpy are numbers; True is none.
    kinds: dict[type, Any] = {int: numbers.Integral, float: numbers.Real, bool: (bool, np.bool_)}
    accepted = kinds.get(kind, kind)
    if not isinstance(value, accepted) or (kind is not bool and isinstance(value, bool)):
        raise ConfigError(f'parameter {name} must be of type {kind.__name__}, not {shown}')
    if choices and value not in choices:
        raise ConfigError(f'parameter {name} must be one of {", ".join(choices)}, not {shown}')
    if low is not None and not low <= value <= high:
        raise ConfigError(f'parameter {name} must be in [{low:g}, {high:g}], not {shown}')
    return kind(value)


def unknown_parameter(name: object, known: Iterable[str]) -> str:
    """Say that there is no parameter of that name, and which of those known looks like it."""
    similar = difflib.get_close_matches(str(name), sorted(known), n=1)
    return f'unknown parameter {name!r}' + (f'; is {similar[0]!r} meant?' if similar else '')
