"""Depth images and organised clouds in the files and folders that people have."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rangeseg_ros.core.sensing.camera import Camera, CameraError
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.extras import import_extra
from rangeseg_ros.io.images import ImageFileError, read_depth
from rangeseg_ros.io.pcd import read_pcd
from rangeseg_ros.io.ply import organised, read_ply

CLOUDS = ('.pcd', '.ply')
SUFFIXES = ('.png', '.tif', '.tiff', '.exr', '.npy', '.npz', *CLOUDS)
# Of the benchmark of TUM, whose images are in 1/5000 m.
_TUM = ('depth.txt', 'associations.txt', 'associate.txt', 'association.txt')
_TUM_SCALE = 1 / 5000


def files_in(path: Path) -> list[Path]:
    """Frames of a folder, sorted by name; a file itself.

    Those of a subfolder `depth` where there is one, and only those named so where some are.

    Raises
    ------
    ImageFileError
        A folder without any.
    """
    if not path.is_dir():
        return [path]
    folder = path / 'depth' if (path / 'depth').is_dir() else path
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES)
    named = [file for file in files if 'depth' in file.name.lower()]
    if not files:
        raise ImageFileError(f'{path}: no depth images in it ({", ".join(SUFFIXES)})')
    return named or files


def scale_of(path: Path) -> float | None:
    """Metres per unit of the images of a folder, where its layout implies it."""
    return _TUM_SCALE if any((path / name).is_file() for name in _TUM) else None


def read_frame(path: Path, intrinsics: Intrinsics, scale: float | None = None) -> RangeImage:
    """Read a depth image or an organised cloud.

    Parameters
    ----------
    path : Path
        One of `SUFFIXES`.
    intrinsics : Intrinsics
        Of depth images.
    scale : float, optional
        Metres per unit; 0.001 for integers and 1 for floats when not given.

    Raises
    ------
    ValueError
        A file that cannot be read, or is of another kind; the message names it.
    """
    suffix = path.suffix.lower()
    known = intrinsics.camera.shape if intrinsics.camera else None
    try:
        if suffix == '.pcd':
            fields = read_pcd(path)
            array = np.stack([fields[axis].astype(np.float32) for axis in 'xyz'], axis=-1)
            if array.shape[0] == 1:
                array = organised(array[0], known, path)
        elif suffix == '.ply':
            array = read_ply(path, known)
        elif suffix in ('.npy', '.npz'):
            array = _read_numpy(path)
        elif suffix == '.exr':
            array = _read_exr(path)
        elif suffix == '.bag':
            raise ImageFileError(f'{path}: a recording; rangeseg replay {path} segments it')
        else:
            array = read_depth(path, known)
    except KeyError as error:
        raise ImageFileError(f'{path}: no field {error} in it') from None
    if array.ndim == 3 and array.shape[2] == 3:
        return RangeImage.from_points(array * np.float32(scale or 1))
    return RangeImage.from_depth(array, intrinsics.of(array.shape), scale)


class Intrinsics:
    """Camera of depth images: of a file, or of numbers and the size of each image.

    Parameters
    ----------
    camera : Camera, optional
    focal : sequence of float, optional
        fx, fy, cx, cy; cx and cy may be None for the middle of the image.
    fov : float, optional
        Horizontal field of view, degrees.
    """

    def __init__(
        self,
        camera: Camera | None = None,
        focal: Sequence[float | None] = (),
        fov: float | None = None,
    ) -> None:
        self.camera, self._focal, self._fov = camera, focal, fov

    def of(self, shape: tuple[int, ...]) -> Camera:
        """Camera of images (H, W).

        Raises
        ------
        CameraError
            Nothing is known of it.
        """
        if self.camera:
            return self.camera
        height, width = shape[:2]
        if self._fov:
            return Camera.from_fov(width, height, self._fov)
        if not self._focal:
            raise CameraError(
                'a depth image needs its intrinsics: --camera FILE, --fov DEGREES, '
                'or --fx, --fy, --cx and --cy'
            )
        fx, fy, cx, cy = self._focal
        fx, fy = fx or fy, fy or fx
        assert fx and fy
        cx, cy = (width - 1) / 2 if cx is None else cx, (height - 1) / 2 if cy is None else cy
        return Camera(width, height, fx, fy, cx, cy)


def _read_numpy(path: Path) -> NDArray:
    try:
        content = np.load(path, allow_pickle=False)
        if isinstance(content, np.ndarray):
            return content
        with content:
            name = 'depth' if 'depth' in content.files else content.files[0]
            array: NDArray = content[name]
            return array
    except (OSError, ValueError, EOFError, IndexError, zipfile.BadZipFile):
        raise ImageFileError(f'{path}: not a readable file of NumPy') from None


def _read_exr(path: Path) -> NDArray[np.float32]:
    try:
        channels = import_extra('OpenEXR').File(str(path)).channels()
        # Grey images have Y, renderers write Z or V; others repeat it in R, G and B.
        (name, *_) = [
            name for name in ('Z', 'Y', 'V', 'depth', 'R', *channels) if name in channels
        ]
        return np.asarray(channels[name].pixels, np.float32)
    except (RuntimeError, ValueError, OSError):
        raise ImageFileError(f'{path}: not a readable EXR file') from None
