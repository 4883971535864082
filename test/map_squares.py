"""Planes of a map: squares, and what frames show of known planes."""

from types import SimpleNamespace

import numpy as np

from rangeseg_ros.core.description.shapes import Shape
from rangeseg_ros.core.mapping.map_planes import MapOutline, MapPlane
from rangeseg_ros.core.mapping.observations import LASTING, RESIDUE
from rangeseg_ros.core.tracking.plane_errors import from_errors, tangents


def plane(number, normal, at, sigma, size=2.0):
    """A square of a plane around a point, whose direction is known to `sigma` radians."""
    normal = np.array(normal, float) / np.linalg.norm(normal)
    axes = tangents(normal[None])[0]
    corners = at + size / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ axes
    jacobian = np.block([[axes.T, np.zeros((3, 1))], [-axes @ at, 1]])
    covariance = jacobian @ np.diag([sigma**2, sigma**2, 1e-6]) @ jacobian.T
    shape = Shape(size**2, np.array([size, size]), np.array(at), np.eye(3))
    names = dict.fromkeys(('label', 'id', 'surface'), number)
    place = {'centroid': np.array(at, float), 'shape': shape, 'outline': MapOutline([[corners]])}
    sure = {'count': 1000, 'rms': 0.002, 'probability': 1.0, 'confidence': 1.0}
    seen = {'observations': 9, 'age': 1.0, 'first_stamp': 0, 'last_stamp': 10**9}
    equation = {'normal': normal, 'distance': float(-normal @ at), 'covariance': covariance}
    return MapPlane(**names, **equation, **place, **sure, **seen)


def observed(random, face, pose, root, lasting=0.0):
    """A plane in the frame of a camera: `root` times an error that lasts and one that is new."""
    normal, distance = pose.rotation.T @ face[:3], face[3] + face[:3] @ pose.shift
    centroid = np.array([0.3, 0.2, 1.0])
    centroid -= (normal @ centroid + distance) * normal
    errors = from_errors(tangents(normal[None]), centroid[None])[0] @ root
    error = np.sqrt(LASTING) * lasting + np.sqrt(1 - LASTING) * random.standard_normal(3)
    off = np.append(normal, distance) + errors @ error
    off /= np.linalg.norm(off[:3])
    centroid = centroid - (off[:3] @ centroid + off[3]) * off[:3]
    covariance = errors @ errors.T / RESIDUE
    equation = {'normal': off[:3], 'distance': off[3], 'covariance': covariance}
    sure = {'confidence': 1.0, 'rms': 0.0, 'area': 1.0, 'count': 1000}
    return SimpleNamespace(**equation, centroid=centroid, **sure)
