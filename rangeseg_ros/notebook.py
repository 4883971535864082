"""Segmenting in one call, and results as pictures, tables and meshes of other libraries."""

from __future__ import annotations

import base64
import html
import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangeseg_ros.core.config import NAMES, Config
from rangeseg_ros.core.description.planes import Plane
from rangeseg_ros.core.options import ConfigError, unknown_parameter
from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.core.segmenter import Segmenter
from rangeseg_ros.core.sensing.camera import Camera
from rangeseg_ros.core.sensing.range_image import RangeImage
from rangeseg_ros.core.sequence import with_roles
from rangeseg_ros.drawing import colours, overlay
from rangeseg_ros.extras import import_extra
from rangeseg_ros.io.corrections import corrected
from rangeseg_ros.io.tables import columns, values


def segment(
    depth: ArrayLike, camera: Camera | None = None, scale: float | None = None, **parameters: Any
) -> Segmentation:
    """Segment a depth image or an organised cloud into planes.

    Says on stderr when kernels are compiled first, once after the installation.

    Parameters
    ----------
    depth : (H, W) integers or floats, or (H, W, 3) float
        Depth along the optical axis, see `RangeImage.from_depth`; without a camera points in
        metres, see `RangeImage.from_points`.
    camera : Camera, optional
        Intrinsics of the depth image.
    scale : float, optional
        Metres per unit; 0.001 for integers and 1 for floats when not given.
    **parameters
        Of `Config`.

    Raises
    ------
    ValueError
        `ConfigError`, `RangeImageError` or another one, whose message says what is wrong.

    Warns
    -----
    UserWarning
        The planes say that up is not as stated, or not as of a level camera.

    Examples
    --------
    >>> result = rangeseg_ros.segment(depth, rangeseg_ros.Camera.from_fov(640, 480, 57))
    """
    for name in sorted(parameters.keys() - NAMES):
        raise ConfigError(unknown_parameter(name, {'scale', *NAMES}))
    config = Config.from_mapping(parameters)
    if camera is None:
        image = RangeImage.from_points(depth if scale is None else scale * np.asanyarray(depth))
    else:
        image = RangeImage.from_depth(depth, camera, scale)
    result = Segmenter(config).segment(corrected(image, config))
    if result.tilt:
        warnings.warn(f'{result.tilt} (result.tilt)', stacklevel=2)
    return replace(result, planes=with_roles(result.planes, config, result.up))


def picture(result: Segmentation) -> NDArray[np.uint8]:
    """Planes in colour over the depth, (H, W, 3) RGB; over black where the image is not kept."""
    inverse = np.zeros(result.labels.shape) if result.image is None else result.image.inverse
    return overlay(inverse, result.labels, result.planes)


def plot(result: Segmentation, axes: Any = None) -> Any:
    """Show `picture` in `axes` of matplotlib, the current ones when not given; returns them."""
    if axes is None:
        import_extra('matplotlib')
        axes = import_extra('matplotlib.pyplot').gca()
    axes.imshow(picture(result))
    axes.set_title(f'{len(result.planes)} planes')
    axes.set_axis_off()
    return axes


def to_html(result: Segmentation) -> str:
    """Picture and table of the planes."""
    _, png = cv2.imencode('.png', cv2.cvtColor(picture(result), cv2.COLOR_RGB2BGR))
    names = ('plane', 'role', 'area (m²)', 'normal', 'distance (m)', 'rms (mm)', 'pixels')
    rows = [''.join(f'<th>{name}</th>' for name in names)]
    for plane, colour in _coloured(result):
        normal = ' '.join(f'{x:.3f}' for x in plane.normal)
        cells = (
            f'<span style="color:rgb{tuple(colour.tolist())}">&#9632;</span> {plane.id}',
            plane.role,
            f'{plane.area:.3g}',
            normal,
            f'{plane.distance:.4g}',
            f'{1000 * plane.rms:.2g}',
            str(plane.count),
        )
        rows.append(''.join(f'<td>{cell}</td>' for cell in cells))
    table = ''.join(f'<tr>{row}</tr>' for row in rows)
    source = f'data:image/png;base64,{base64.b64encode(png.tobytes()).decode()}'
    return (
        f'<p>{html.escape(repr(result))}<br>Input: {html.escape(str(result.verdict))}</p>'
        f'<img src="{source}" style="max-width:100%"><table>{table}</table>'
    )


def to_pandas(result: Segmentation) -> Any:
    """pandas.DataFrame with a row for each plane and the columns of planes.csv."""
    rows = [values(plane) for plane in result.planes]
    return import_extra('pandas').DataFrame(rows, columns=columns())


def to_trimesh(result: Segmentation) -> Any:
    """trimesh.Scene with a coloured mesh for each plane, in the frame of the image."""
    trimesh = import_extra('trimesh')
    scene = trimesh.Scene()
    for plane, colour in _coloured(result):
        mesh = trimesh.Trimesh(*plane.mesh(), face_colors=[*colour, 255], process=False)
        scene.add_geometry(mesh, geom_name=f'plane {plane.id}')
    return scene


def to_open3d(result: Segmentation) -> list[Any]:
    """Coloured open3d.geometry.TriangleMesh of each plane, in the frame of the image."""
    open3d = import_extra('open3d')
    meshes = []
    for plane, colour in _coloured(result):
        vertices, triangles = plane.mesh()
        mesh = open3d.geometry.TriangleMesh(
            open3d.utility.Vector3dVector(vertices),
            open3d.utility.Vector3iVector(triangles.astype(np.int32)),
        )
        meshes.append(mesh.paint_uniform_color(colour / 255))
    return meshes


def _coloured(result: Segmentation) -> Iterator[tuple[Plane, NDArray[np.uint8]]]:
    """Planes and their colours."""
    return zip(result.planes, colours([plane.id for plane in result.planes]), strict=True)
