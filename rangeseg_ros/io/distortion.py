"""Distortion maps in files: TIFF with a float32 page for each of offset, deviation and slope.

The description tag of the first page holds, as JSON, the camera; other programs' maps, of one page
and without a description, are read as well. The third page is the slope of an offset at 1/z = 0.
Where the offset holds at another inverse depth, which the description states, the third page is
zero and the slope the fourth: those who read the offset alone, or add the third page times 1/z,
have the map that is right at that distance.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import asdict
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageSequence, TiffImagePlugin

from rangeseg_ros.core.arrays import Singles
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.distortion import DistortionError, DistortionMap
from rangeseg_ros.io.files import replacing

KIND = 'rangeseg_ros distortion map'
_DESCRIPTION = 270


def read_distortion(path: Path) -> DistortionMap:
    """Read a distortion map; DistortionError where it is none, or its values are not finite."""
    try:
        # Of damage the reader only warns.
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            with Image.open(path, formats=['TIFF']) as file:
                description = str(file.tag_v2.get(_DESCRIPTION, ''))  # type: ignore[attr-defined]
                pages = [_page(page) for page in ImageSequence.Iterator(file)]
        return _map_of(pages, _about(description))
    except DistortionError as error:
        raise DistortionError(f'{path}: {error}') from None
    except FileNotFoundError as error:
        raise DistortionError(f'{path}: {error.strerror}') from None
    # Damaged files are met with exceptions of every kind.
    except Exception:
        raise DistortionError(f'{path}: not a readable TIFF') from None


def _map_of(pages: list[Singles], about: dict[str, Any]) -> DistortionMap:
    if len(pages) > 4 or any(page.shape != pages[0].shape for page in pages):
        raise DistortionError('not one to four pages of one size')
    try:
        camera = Camera(**about['camera']) if about.get('camera') else None
        reference = float(about['reference']) if len(pages) == 4 else 0.0
    except (KeyError, TypeError, ValueError):
        raise DistortionError('damaged description') from None
    if not np.isfinite(reference) or (len(pages) == 4 and pages.pop(2).any()):
        raise DistortionError('a third page beside a reference')
    maps: dict[str, Any] = dict(zip(('offset', 'deviation', 'slope'), pages, strict=False))
    return DistortionMap(**maps, camera=camera, reference=reference)


def write_distortion(path: Path, distortion: DistortionMap) -> None:
    """Write a distortion map, whole or not at all."""
    parts = (distortion.offset, distortion.deviation, distortion.slope)
    pages = list(takewhile(lambda page: page is not None, parts))
    if distortion.reference and len(pages) == 3:
        pages.insert(2, np.zeros_like(distortion.offset))
    about: dict[str, Any] = {'kind': KIND, 'unit': '1/m'}
    if distortion.reference:
        about['reference'] = distortion.reference
    if distortion.camera is not None:
        about['camera'] = asdict(distortion.camera)
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[_DESCRIPTION] = json.dumps(about)
    first, *others = (Image.fromarray(np.ascontiguousarray(page, np.float32)) for page in pages)
    with replacing(path) as partial:
        first.save(partial, 'TIFF', save_all=True, append_images=others, tiffinfo=tags)


def _page(page: Image.Image) -> Singles:
    if page.mode != 'F':
        raise DistortionError(f'a distortion map is float32 of one channel, not {page.mode}')
    values = np.array(page, np.float32)
    if not np.isfinite(values).all():
        raise DistortionError('values that are not finite')
    values.setflags(write=False)
    return values


def _about(description: str) -> dict[str, Any]:
    try:
        about = json.loads(description)
    except ValueError:
        return {}
    return about if isinstance(about, dict) and about.get('kind') == KIND else {}
