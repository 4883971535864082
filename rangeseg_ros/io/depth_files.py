"""Depth images and organised clouds in the files and folders that people have."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.arrays import Singles
from rangeseg_ros.core.sensing.camera import Camera, CameraError
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.extras import import_extra
from rangeseg_ros.io.files import FileError, natural_order
from rangeseg_ros.io.images import read_depth
from rangeseg_ros.io.pcd import read_pcd
from rangeseg_ros.io.ply import organised, read_ply

IMAGES = ('.png', '.tif', '.tiff', '.pgm', '.pfm')
CLOUDS = ('.pcd', '.ply')
SUFFIXES = (*IMAGES, '.exr', '.npy', '.npz', *CLOUDS)
# Of the benchmark of TUM, whose images are in 1/5000 m.
_TUM = ('depth.txt', 'associations.txt', 'associate.txt', 'association.txt')
_TUM_SCALE = 1 / 5000


def files_of(folder: Path, suffixes: Collection[str] = IMAGES) -> list[Path]:
    """Files of a folder that end so, in the order of their names, 2 before 10."""
    files = (path for path in folder.iterdir() if path.suffix.lower() in suffixes)
    # Beside each file, macOS leaves a hidden one of its name.
    return sorted((path for path in files if path.name[0] != '.'), key=natural_order)


def files_in(path: Path) -> list[Path]:
    """Frames of a folder, FileError where there are none; a file itself.

    Of its subfolder `depth` where there is one; where some names contain `depth`, only these.
    """
    if not path.is_dir():
        return [path]
    files = files_of(path / 'depth' if (path / 'depth').is_dir() else path, SUFFIXES)
    if not files:
        raise FileError(f'{path}: no depth images in it ({", ".join(SUFFIXES)})')
    return [file for file in files if 'depth' in file.name.lower()] or files


def scale_of(path: Path) -> float | None:
    """Metres per unit of the images of a folder, where its layout implies it."""
    return _TUM_SCALE if any((path / name).is_file() for name in _TUM) else None


@dataclass(frozen=True)
class Intrinsics:
    """What is known of the camera of depth images.

    It, or `focal`: fx, fy, cx, cy, of which cx and cy may be None for the middle of the image, or
    `fov`: the horizontal field of view, degrees.
    """

    camera: Camera | None = None
    focal: Sequence[float | None] = ()
    fov: float | None = None

    def of(self, shape: tuple[int, ...]) -> Camera:
        """Camera of images (H, W); CameraError where nothing is known of it."""
        height, width = shape[:2]
        if self.camera:
            return self.camera
        if self.fov is not None:
            return Camera.from_fov(width, height, self.fov)
        if not self.focal:
            raise CameraError(
                'a depth image needs its intrinsics: --camera FILE, --fov DEGREES, '
                'or --fx, --fy, --cx and --cy'
            )
        fx, fy, cx, cy = self.focal
        fx, fy = fy if fx is None else fx, fx if fy is None else fy
        assert fx is not None and fy is not None
        cx, cy = (width - 1) / 2 if cx is None else cx, (height - 1) / 2 if cy is None else cy
        return Camera(width, height, fx, fy, cx, cy)


def read_frame(path: Path, intrinsics: Intrinsics, scale: float | None = None) -> RangeImage:
    """Read a depth image or an organised cloud, one of `SUFFIXES`; ValueError names the file.

    `scale` is metres per unit; 0.001 for integers and 1 for floats when not given.
    """
    suffix = path.suffix.lower()
    known = intrinsics.camera.shape if intrinsics.camera else None
    if suffix == '.pcd':
        points = read_pcd(path, *'xyz')
        array: NDArray = organised(points[0], known, path) if len(points) == 1 else points
    elif suffix == '.ply':
        array = read_ply(path, known)
    elif suffix in ('.npy', '.npz'):
        array = _read_numpy(path, known)
    elif suffix == '.exr':
        array = _read_exr(path)
    elif suffix == '.bag':
        raise FileError(f'{path}: a recording; rangeseg replay {path} segments it')
    else:
        array = read_depth(path, known)
    if not array.size:
        raise FileError(f'{path}: no pixels, {array.shape}')
    if array.ndim == 3 and array.shape[2] == 3:
        if array.shape[0] == 1 < array.shape[1]:
            raise FileError(f'{path}: cloud is not organised ({array.shape[1]}x1)')
        return RangeImage.from_points(array * np.float32(scale or 1))
    return RangeImage.from_depth(array, intrinsics.of(array.shape), scale)


def _read_numpy(path: Path, shape: tuple[int, int] | None) -> NDArray:
    try:
        array = np.load(path, allow_pickle=False)
        if not isinstance(array, np.ndarray):
            with array as arrays:
                names = {name.lower(): name for name in arrays.files}
                array = arrays[names.get('depth', arrays.files[0])]
    except Exception:  # damaged bytes raise errors of every kind
        raise FileError(f'{path}: not a readable file of NumPy') from None
    if array.ndim != 2 and (array.ndim != 3 or array.dtype.kind != 'f'):
        raise FileError(
            f'{path}: no depth (H, W) nor points (H, W, 3), {array.shape} {array.dtype}'
        )
    return organised(array, shape, path) if array.shape[1:] == (3,) else array


def _read_exr(path: Path) -> Singles:
    try:
        channels = import_extra('OpenEXR').File(str(path), separate_channels=True).channels()
    except (RuntimeError, ValueError, OSError):
        raise FileError(f'{path}: not a readable EXR file') from None
    # Renderers write Z or V, maybe of a layer Depth; grey images have Y, or R, G and B alike.
    names = [n for n in channels if n.rpartition('.')[2] in ('Z', 'V', 'Y', 'depth')]
    names = [n for n in names if 'depth' in n.lower()] or names
    names = names or [n for n in channels if n[-1] != 'A']
    found = [np.asarray(channels[n].pixels).astype(np.float32) for n in names]
    if not found or any(not np.array_equal(found[0], x, equal_nan=True) for x in found):
        raise FileError(f'{path}: which is depth? Its channels: {", ".join(channels)}')
    return found[0]
