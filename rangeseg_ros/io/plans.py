"""Floor plans as files: DXF, GeoJSON, a map for Nav2, and meshes.

All are in metres in the frame of the plan, with z up. DXF and GLB need the extra `plan`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rangeseg_ros.core.arrays import Floats
from rangeseg_ros.drawing import colours
from rangeseg_ros.io.files import replacing
from rangeseg_ros.io.meshes import write_mesh
from rangeseg_ros.plan.floor_plan import FREE, OCCUPIED, FloorPlan, deviation_of
from rangeseg_ros.plan.right_angles import Squared

# Shades of map_server, and thresholds between them: 205 is unknown, as 1 - 205 / 255 lies between.
_SHADES = {FREE: 254, OCCUPIED: 0}
_UNKNOWN, _OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 205, 0.65, 0.196

# Layers of the drawing and their colours.
_LAYERS = {'WALLS': 1, 'FACES': 8, 'OPENINGS': 5, 'FLOOR': 3, 'LEVEL': 30, 'PLANES': 9, 'TEXT': 7}
_LAYERS['STAIRS'] = 6


def plan_files() -> dict[str, Callable[[Path, FloorPlan], None]]:
    """What writes each file of a plan, by its name."""
    return {
        'plan.dxf': write_dxf,
        'plan.geojson': write_geojson,
        'map.pgm': _write_pgm,
        'map.yaml': _write_yaml,
        'map.ply': lambda path, plan: write_mesh(path, plan.planes),
        'map.glb': _write_glb,
    }


def plane_row(plane: Squared) -> dict[str, Any]:
    """What is told of a plane of a plan: plain values, metres and degrees."""
    heights = np.concatenate(plane.outline.rings)[:, 2]
    turn = np.degrees(np.sqrt(max(np.trace(plane.covariance[:3, :3]), 0)))
    return {
        'id': plane.id,
        'role': plane.role,
        'area': round(plane.area, 4),
        'deviation': round(deviation_of(plane), 5),
        'deviation_degrees': round(float(turn), 4),
        'exact': plane.exact,
        'group': plane.group,
        'turned_degrees': round(float(np.degrees(plane.turned)), 4),
        'low': round(float(heights.min()), 4),
        'high': round(float(heights.max()), 4),
        'normal': [round(float(v), 6) for v in plane.normal],
        'distance': round(plane.distance, 5),
        'observations': plane.observations,
    }


def write_dxf(path: Path, plan: FloorPlan) -> None:
    """Write the plan for CAD; PLANES has all parts of all planes in space."""
    import ezdxf
    from ezdxf import units

    document = ezdxf.new('R2010', setup=True)
    document.units = units.M
    for name, colour in _LAYERS.items():
        document.layers.add(name, color=colour)
    space = document.modelspace()
    for wall in plan.walls:
        plane = plan.planes[wall.plane]
        layer = 'WALLS' if plane.role == 'wall' else 'FACES'
        for start, end in wall.segments:
            space.add_line(start, end, dxfattribs={'layer': layer})
        if plane.role == 'wall':
            text = f'{plane.id}: +-{1e3 * deviation_of(plane):.1f} mm'
            at = wall.segments.reshape(-1, 2).mean(axis=0)
            space.add_text(text, height=0.08, dxfattribs={'layer': 'TEXT'}).set_placement(at)
    for opening in plan.openings:
        start, end = opening.ends
        space.add_line(start, end, dxfattribs={'layer': 'OPENINGS', 'linetype': 'DASHED'})
    for start, end in (edge for flight in plan.stairs for edge in flight.edges):
        space.add_line(start, end, dxfattribs={'layer': 'STAIRS'})
    for plane in plan.planes:
        layer = 'FLOOR' if plane.role == 'floor' else 'LEVEL'
        about = {'layer': layer, 'elevation': float(plane.centroid[2])}
        for ring in plane.outline.rings:
            space.add_polyline3d(ring.tolist(), close=True, dxfattribs={'layer': 'PLANES'})
            if plane.drawn:
                space.add_lwpolyline(ring[:, :2].tolist(), close=True, dxfattribs=about)
    document.saveas(path)


def write_geojson(path: Path, plan: FloorPlan) -> None:
    """Write the planes as features, metres in the frame of the plan, no longitudes.

    Level and sloping planes are polygons with holes, upright ones lines; `parts` has the borders
    of all parts in space.
    """
    features = []
    walls = {wall.plane: wall.segments for wall in plan.walls}
    for k, plane in enumerate(plan.planes):
        parts = [[_rounded(np.append(r, r[:1], 0)) for r in p] for p in plane.outline.parts]
        if k in walls:
            geometry = {'type': 'MultiLineString', 'coordinates': _rounded(walls[k])}
        elif abs(plane.normal[2]) < 0.1:
            # Upright, and above or below all that a robot meets: its whole width.
            corners = np.concatenate(plane.outline.rings)[:, :2]
            order = np.argsort(corners @ [-plane.normal[1], plane.normal[0]])[[0, -1]]
            geometry = {'type': 'MultiLineString', 'coordinates': [_rounded(corners[order])]}
        else:
            flat = [[[corner[:2] for corner in ring] for ring in part] for part in parts]
            geometry = {'type': 'MultiPolygon', 'coordinates': flat}
        features.append((geometry, {**plane_row(plane), 'parts': parts}))
    for opening in plan.openings:
        about = {'role': 'opening', 'width': round(opening.width, 4)}
        about['wall'] = plan.planes[opening.plane].id
        features.append(({'type': 'LineString', 'coordinates': _rounded(opening.ends)}, about))
    for flight in plan.stairs:
        about = {'role': 'stairs', 'direction': flight.direction, 'treads': len(flight.edges) - 1}
        about |= {'rise': round(flight.rise, 4), 'run': round(flight.run, 4)}
        lines = {'type': 'MultiLineString', 'coordinates': _rounded(flight.edges)}
        features.append((lines, about))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = plan.motion
    collection = {
        'type': 'FeatureCollection',
        'frame': plan.frame,
        'plan_from_frame': _rounded(matrix, 9),
        'units': 'metres',
        'up': {'direction': _rounded(plan.up.direction, 6), 'source': plan.up.source},
        'ground': round(plan.ground, 4),
        'features': [
            {'type': 'Feature', 'geometry': geometry, 'properties': about}
            for geometry, about in features
        ],
    }
    path.write_text(json.dumps(collection, indent=1), encoding='utf-8')


def _rounded(values: Floats, digits: int = 4) -> Any:
    return np.round(values, digits).tolist()


def _write_pgm(path: Path, plan: FloorPlan) -> None:
    shades = np.full(plan.cells.shape, _UNKNOWN, np.uint8)
    for value, shade in _SHADES.items():
        shades[plan.cells == value] = shade
    # Row 0 of the picture is at the greatest y.
    _, data = cv2.imencode('.pgm', shades[::-1])
    path.write_bytes(data.tobytes())


def _write_yaml(path: Path, plan: FloorPlan) -> None:
    x, y = plan.origin
    path.write_text(
        'image: map.pgm\nmode: trinary\n'
        f'resolution: {plan.resolution:g}\norigin: [{x:.9g}, {y:.9g}, 0.0]\nnegate: 0\n'
        f'occupied_thresh: {_OCCUPIED_THRESHOLD}\nfree_thresh: {_FREE_THRESHOLD}\n'
    )


def _write_glb(path: Path, plan: FloorPlan) -> None:
    import trimesh

    scene = trimesh.Scene()
    for plane in plan.planes:
        corners, faces = plane.mesh()
        material = trimesh.visual.material.PBRMaterial(
            baseColorFactor=[*colours([plane.id])[0].tolist(), 255],
            metallicFactor=0.0,
            doubleSided=True,
        )
        # In glTF, y is up.
        mesh = trimesh.Trimesh(
            corners[:, [0, 2, 1]] * (1, 1, -1),
            faces,
            process=False,
            visual=trimesh.visual.TextureVisuals(material=material),
        )
        name = f'{plane.role}_{plane.id}'
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    path.write_bytes(scene.export(file_type='glb'))


def write_plan(folder: Path, plan: FloorPlan) -> None:
    """Write all files of a plan into a folder, each whole or not at all."""
    for name, write in plan_files().items():
        with replacing(folder / name) as partial:
            write(partial, plan)
