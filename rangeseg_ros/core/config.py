"""Every parameter of the segmenter: its default, range and description, in one place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any


class ConfigError(ValueError):
    """A parameter that does not exist, or a value outside its range."""


def option(
    default: bool | int | float | str,
    description: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare a `Config` field; `low` and `high` are inclusive."""
    metadata = {'description': description, 'low': low, 'high': high, 'choices': choices}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Config:
    """Parameters of `Segmenter`; the defaults suit a Kinect-style sensor.

    Raises
    ------
    ConfigError
        A value of the wrong type or outside its range; the message names the parameter and
        its range.
    """

    method: str = option(
        'planes',
        'labels are planes, refined (planes), or discretised normals as in the thesis (normals)',
        choices=('planes', 'normals'),
    )
    smoothness: float = option(
        55.0,
        'method normals: lambda of eq. 5.3, weight of the Potts prior against degrees of angle',
        low=0.0,
        high=10000.0,
    )

    def __post_init__(self) -> None:
        for option_field in fields(self):
            value = _checked(option_field, getattr(self, option_field.name))
            object.__setattr__(self, option_field.name, value)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Config:
        """Build a Config from parameter names and values, as read from a YAML file.

        Raises
        ------
        ConfigError
            An unknown name, or a value that the named parameter does not take.
        """
        known = {option_field.name for option_field in fields(cls)}
        for name in mapping:
            if name not in known:
                raise ConfigError(f'unknown parameter {name!r}; known: {", ".join(sorted(known))}')
        return cls(**mapping)


def _checked(option_field: Any, value: Any) -> Any:
    """Return `value` in the type of the field's default, or raise ConfigError."""
    name, kind = option_field.name, type(option_field.default)
    low, high = option_field.metadata['low'], option_field.metadata['high']
    choices = option_field.metadata['choices']
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ConfigError(f'parameter {name} must be of type {kind.__name__}, not {value!r}')
    if choices and value not in choices:
        raise ConfigError(f'parameter {name} must be one of {", ".join(choices)}, not {value!r}')
    if low is not None and not low <= value <= high:
        raise ConfigError(f'parameter {name} must be in [{low:g}, {high:g}], not {value!r}')
    return value
