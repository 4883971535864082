"""Self-contained HTML pages: pictures, charts and style are part of the file."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jinja2
import numpy as np

from rangeseg_ros.io.files import replacing

MAX_PICTURES = 48
"""Pictures in a contact sheet; of longer sequences as many, evenly spaced."""


class Picture(NamedTuple):
    """A picture of a contact sheet: an image file and what to write below it."""

    path: Path
    title: str


def render(template: str, **values: Any) -> str:
    """Fill in a template of this package."""
    return _environment().get_template(template).render(values)


def write_page(path: Path, template: str, **values: Any) -> None:
    """Write the page of a template of this package, whole or not at all."""
    values['kind'] = template.removesuffix('.html')
    text = render(template, **values)
    with replacing(path) as partial:
        partial.write_text(text, encoding='utf-8')


def page_kind(path: Path) -> str:
    """Which of the pages of this package a file is: the name of its template, or ''."""
    with path.open('rb') as file:
        found = re.search(rb'<meta name="generator" content="rangeseg (\w+)">', file.read(500))
    return found[1].decode() if found else ''


def evenly_spaced(pictures: Sequence[Picture]) -> list[Picture]:
    """At most `MAX_PICTURES`, evenly spaced, the first and the last among them."""
    count = min(len(pictures), MAX_PICTURES)
    chosen = np.linspace(0, len(pictures) - 1, count).round().astype(int)
    return [pictures[index] for index in chosen]


@cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('rangeseg_ros.report'),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters['svg'] = lambda text: _data('image/svg+xml', text.encode())
    environment.filters['jpeg'] = _jpeg
    return environment


def _jpeg(path: Path) -> str:
    bgr = cv2.imread(str(path))
    if bgr is None:  # somebody has removed it meanwhile
        bgr = np.zeros((1, 1, 3), np.uint8)
    _, jpeg = cv2.imencode('.jpg', bgr, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return _data('image/jpeg', jpeg.tobytes())


def _data(kind: str, content: bytes) -> str:
    return f'data:{kind};base64,{b64encode(content).decode()}'
