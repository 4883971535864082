"""Pictures of segmentations: labels over the range image, normals as colours."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Mask
from rangeseg_ros.core.description.planes import Plane

_SQUARE = np.ones((3, 3), np.uint8)


def colours(ids: Sequence[int] | NDArray) -> NDArray[np.uint8]:
    """Colours of plane ids, (N, 3) RGB: fixed, and easy to distinguish.

    There are 48 of them, each at the largest distance from all before it in CIE L*a*b* (Glasbey
    et al., Color Research and Application 32, 2007); greys are left to what has no plane.
    """
    return _palette()[(np.asarray(ids, int) - 1) % len(_palette())]


@cache
def _palette() -> NDArray[np.uint8]:
    steps = np.linspace(0, 1, 12, dtype=np.float32)
    rgb = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    lab = cv2.cvtColor(rgb[None], cv2.COLOR_RGB2LAB)[0]
    lightness, chroma = lab[:, 0], np.hypot(lab[:, 1], lab[:, 2])
    bright = (lightness > 45) & (lightness < 90) & (chroma > 55)
    rgb, lab = rgb[bright], lab[bright]
    chosen = [int(np.argmin(np.linalg.norm(lab - (60, 0, -60), axis=1)))]
    nearest = np.full(len(lab), np.inf)
    for _ in range(47):
        nearest = np.minimum(nearest, np.linalg.norm(lab - lab[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(nearest)))
    return np.round(255 * rgb[chosen]).astype(np.uint8)


def grey(inverse: NDArray) -> NDArray[np.uint8]:
    """Grey picture of inverse range, near = bright, nothing measured = black; (H, W)."""
    # Of every third row and column, where an image is large: the extremes of so many are the same.
    step = 3 if inverse.size > 100 * 100 else 1
    some = inverse[::step, ::step]
    some = some[some > 0]
    if not some.size:
        some = inverse[inverse > 0]
    if not some.size:
        return np.zeros(inverse.shape, np.uint8)
    low, high = np.percentile(some, (2, 98))
    scale = np.float32(175 / max(high - low, 1e-9))
    picture = np.clip((inverse - np.float32(low)) * scale, 0, 175).astype(np.uint8) + np.uint8(60)
    return picture * (inverse > 0)


def overlay(
    inverse: NDArray, labels: NDArray[np.uint16], planes: Sequence[Plane] = ()
) -> NDArray[np.uint8]:
    """Colour labels (H, W) over a grey picture of the inverse range; (H, W, 3) uint8 RGB.

    Colours follow the ids of `planes`, where they are given, which are also written on them.
    """
    numbers = np.arange(int(labels.max(initial=0)) + 1)
    for plane in planes:
        numbers[plane.label] = plane.id
    palette = colours(numbers)
    base = cv2.cvtColor(grey(inverse), cv2.COLOR_GRAY2RGB)
    shown = palette.take(labels, axis=0, mode='clip')
    picture: NDArray = cv2.addWeighted(base, 0.45, shown, 0.55, 0)
    cv2.copyTo(base, (labels == 0).view(np.uint8), picture)
    cv2.copyTo(np.zeros_like(base), (borders(labels) & (labels > 0)).view(np.uint8), picture)
    half = labels[::2, ::2].copy()
    for plane in planes:
        _write_id(picture, half == plane.label, str(plane.id))
    return picture


def borders(labels: NDArray[np.uint16]) -> Mask:
    """Pixels whose right or lower neighbour has another label."""
    border = np.zeros(labels.shape, bool)
    border[:, :-1] |= labels[:, :-1] != labels[:, 1:]
    border[:-1] |= labels[:-1] != labels[1:]
    return border


def _write_id(picture: NDArray[np.uint8], region: Mask, text: str) -> None:
    """Write `text` where the region is widest, if it is wide enough, inside of the picture.

    White, with a black outline; `region` has every second row and column of `picture`.
    """
    x, y, width, height = cv2.boundingRect(region.view(np.uint8))
    part = region[y : y + height, x : x + width].view(np.uint8)
    around = cv2.copyMakeBorder(part, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    inside = cv2.distanceTransform(around, cv2.DIST_L2, 3)
    _, radius, _, (column, row) = cv2.minMaxLoc(inside)
    if radius < 4:
        return
    scale, centre = min(0.8, radius / 15 + 0.2), (2 * (y + row - 1), 2 * (x + column - 1))
    # The outline grows from the text itself: bold letters are wider in some versions of OpenCV.
    letters = np.zeros((40, 20 * len(text) + 20), np.uint8)
    cv2.putText(letters, text, (9, 28), cv2.FONT_HERSHEY_SIMPLEX, scale, 255, 1, cv2.LINE_AA)
    left, top, wide, high = cv2.boundingRect(letters)
    letters = letters[top - 1 : top + high + 1, left - 1 : left + wide + 1]
    outline = cv2.dilate(letters, _SQUARE)
    top, left = (
        max(0, min(middle - size // 2, full - size))
        for middle, size, full in zip(centre, letters.shape, picture.shape, strict=False)
    )
    part = picture[top : top + letters.shape[0], left : left + letters.shape[1]]
    rows, columns = part.shape[:2]
    part[:] = part * (1 - outline[:rows, :columns, None] / 255)
    np.maximum(part, letters[:rows, :columns, None], out=part)
