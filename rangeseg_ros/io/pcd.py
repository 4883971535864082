"""Organised point clouds in PCD files, which `pypcd4` reads."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np

from rangeseg_ros.core.arrays import Singles
from rangeseg_ros.extras import import_extra
from rangeseg_ros.io.files import FileError, read_bytes


def read_pcd(path: Path, *fields: str) -> Singles:
    """Values (H, W, n) of n fields of a PCD file; an unorganised cloud has H = 1.

    FileError: it cannot be read, is damaged, or lacks one of the fields.
    """
    library, data = import_extra('pypcd4'), read_bytes(path)
    try:
        cloud = library.PointCloud.from_fileobj(BytesIO(data))
        shape = cloud.metadata.height, cloud.metadata.width
    # It meets damaged bytes with exceptions of every kind.
    except Exception:
        raise FileError(f'{path}: not a readable PCD file') from None
    if missing := sorted({*fields} - {*cloud.fields}):
        raise FileError(f'{path}: no field {", ".join(missing)} in it')
    values = np.stack([cloud.pc_data[name].astype(np.float32) for name in fields], axis=-1)
    if len(values) != shape[0] * shape[1] or not values.size:
        raise FileError(f'{path}: {len(values)} points where {shape[1]}x{shape[0]} are announced')
    return values.reshape(*shape, -1)
