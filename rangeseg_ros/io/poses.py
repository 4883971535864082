"""Poses of cameras in text files: 4x4 matrices, one for each image, and trajectories."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from rangeseg_ros.core.mapping.transforms import Transform, TransformError
from rangeseg_ros.core.rotations import quaternions
from rangeseg_ros.io.files import FileError, read_bytes, replacing


def match_poses(images: Iterable[Path], folder: Path) -> dict[Path, Path]:
    """Find the text file in `folder` with the pose of each image, of those that have one.

    That of <stem>.png is <stem>.txt or <stem>.pose.txt, or else the file whose last number is that
    of the image: frame-7.pose.txt for frame-0007.depth.png. FileError: no text file at all, or two
    of one number where the number decides.
    """
    files = sorted(folder.glob('*.txt'))
    if not files:
        raise FileError(f'{folder}: no .txt files with poses')
    by_stem = {path.name.removesuffix('.txt').removesuffix('.pose'): path for path in files}
    by_number: dict[int | None, list[Path]] = {}
    for path in files:
        by_number.setdefault(_number(path), []).append(path)
    found = {}
    for image in images:
        number = _number(image)
        same = [] if number is None else by_number.get(number, [])
        if image.stem in by_stem:
            found[image] = by_stem[image.stem]
        elif len(same) > 1:
            raise FileError(f'{image.name} may belong to {same[0].name} or {same[1].name}')
        elif same:
            found[image] = same[0]
    return found


def read_pose(path: Path) -> Transform:
    """Read a 4x4 matrix, row-major, metres: p_world = T p_camera; FileError names a fault."""
    data = read_bytes(path)
    try:
        values = [float(word) for word in data.replace(b',', b' ').split()]
        return Transform.from_matrix(np.reshape(values, (4, 4)))
    except TransformError as error:
        raise FileError(f'{path.name}: {error}') from None
    except ValueError:
        raise FileError(f'{path.name}: not 16 numbers') from None


def _number(path: Path) -> int | None:
    """Last number in a name."""
    numbers = re.findall(r'\d+', path.stem)
    return int(numbers[-1]) if numbers else None


def seconds_of(stamp: int) -> str:
    """A time, nanoseconds, in decimal seconds."""
    seconds, rest = divmod(abs(stamp), 10**9)
    return f'{"-" * (stamp < 0)}{seconds}.{rest:09d}'


def write_trajectory(path: Path, poses: Sequence[tuple[int, Transform]]) -> None:
    """Write stamps (nanoseconds) and poses as the TUM RGB-D benchmark has them.

    A row each of seconds, x, y, z (metres) and the quaternion x, y, z, w.
    """
    lines = ['# timestamp tx ty tz qx qy qz qw']
    for stamp, pose in poses:
        numbers = ' '.join(f'{x:.9g}' for x in (*pose.shift, *quaternions(pose.rotation)))
        lines.append(f'{seconds_of(stamp)} {numbers}')
    with replacing(path) as partial:
        partial.write_text('\n'.join([*lines, '']))
