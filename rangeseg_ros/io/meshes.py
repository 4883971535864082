"""Polygons as coloured triangle meshes: PLY files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rangeseg_ros.core.mapping.map_planes import MapPlane
from rangeseg_ros.drawing import colours
from rangeseg_ros.io.files import replacing

_HEADER = """ply
format ascii 1.0
comment planes of a map, metres
element vertex {}
property double x
property double y
property double z
property uchar red
property uchar green
property uchar blue
element face {}
property list uchar int vertex_indices
end_header
"""


def write_mesh(path: Path, planes: Sequence[MapPlane]) -> None:
    """Write the outlines of planes, all parts with their holes, as triangles in their colours."""
    vertices: list[str] = []
    faces: list[str] = []
    shades = colours([plane.id for plane in planes]).tolist()
    for plane, colour in zip(planes, shades, strict=True):
        corners, triangles = plane.mesh()
        rgb = ' '.join(map(str, colour))
        faces += ['3 {} {} {}'.format(*t) for t in len(vertices) + triangles]
        vertices += [f'{x:.6f} {y:.6f} {z:.6f} {rgb}' for x, y, z in corners.tolist()]
    text = _HEADER.format(len(vertices), len(faces))
    with replacing(path) as partial:
        partial.write_text(text + ''.join(f'{line}\n' for line in [*vertices, *faces]))
