"""Poses of cameras in text files: 4x4 matrices, one for each image, and trajectories."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from rangeseg_ros.core.mapping.transforms import Transform, TransformError
from rangeseg_ros.core.rotations import quaternions
from rangeseg_ros.io.files import replacing


class PoseFileError(ValueError):
    """Pose files that cannot be matched to images, or a file that holds no pose."""


def match_poses(images: Iterable[Path], folder: Path) -> dict[Path, Path]:
    """Find the pose of each image by its name.

    Parameters
    ----------
    images : iterable of Path
    folder : Path
        Of text files. The pose of <stem>.png is <stem>.txt or <stem>.pose.txt, or else the file
        whose last number is that of the image: frame-7.pose.txt for frame-0007.depth.png.

    Returns
    -------
    dict
        Images that have one, with their poses.

    Raises
    ------
    PoseFileError
        No text file at all, or two of one number where the number decides.
    """
    files = sorted(folder.glob('*.txt'))
    if not files:
        raise PoseFileError(f'{folder}: no .txt files with poses')
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
            raise PoseFileError(f'{image.name} may belong to {same[0].name} or {same[1].name}')
        elif same:
            found[image] = same[0]
    return found


def read_pose(path: Path) -> Transform:
    """Read a 4x4 matrix, row-major, metres: p_world = T p_camera.

    Raises
    ------
    PoseFileError
        A file that cannot be read, or no rigid motion: the message says what is wrong.
    """
    try:
        values = [float(word) for word in path.read_text().replace(',', ' ').split()]
        return Transform.from_matrix(np.reshape(values, (4, 4)))
    except OSError as error:
        raise PoseFileError(f'{path.name}: {error.strerror}') from None
    except TransformError as error:
        raise PoseFileError(f'{path.name}: {error}') from None
    except ValueError:
        raise PoseFileError(f'{path.name}: not 16 numbers') from None


def _number(path: Path) -> int | None:
    """Last number in a name."""
    numbers = re.findall(r'\d+', path.stem)
    return int(numbers[-1]) if numbers else None


def write_trajectory(path: Path, poses: Sequence[tuple[int, Transform]]) -> None:
    """Write stamps (nanoseconds) and poses as the TUM RGB-D benchmark has them.

    A row each of seconds, x, y, z (metres) and the quaternion x, y, z, w.
    """
    rows = [
        f'{stamp // 10**9}.{stamp % 10**9:09d} '
        + ' '.join(f'{value:.9g}' for value in (*pose.shift, *quaternions(pose.rotation)))
        for stamp, pose in poses
    ]
    with replacing(path) as partial:
        partial.write_text(
            '# timestamp tx ty tz qx qy qz qw\n' + ''.join(f'{row}\n' for row in rows)
        )
