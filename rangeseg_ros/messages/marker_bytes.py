"""Markers as they go over the wire, without the objects of a message.

A hull has a hundred points, each of them an object of Python to rclpy, to be made and read again:
written as they are they take half the time, outlines and triangles included. The layout is that of
OMG CDR, little-endian: what follows the four bytes of the encapsulation is aligned to its size.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any

import numpy as np

from rangeseg_ros.messages.markers import CLEAR, Marker

_LITTLE_ENDIAN = b'\0\1\0\0'
_EMPTY_TEXT = struct.pack('<I4x', 1)
# Of a marker, from where it lies to its points: pose, scale, colour, lifetime, frame_locked.
_PLACED = struct.Struct('<10d4fiI?')
# From the points to the text: colours, texture_resource, texture (header, format, data), uv.
_UNTEXTURED = struct.pack('<I', 0) + _EMPTY_TEXT + bytes(8) + 2 * _EMPTY_TEXT + bytes(8)
# From the text to the end: mesh_resource, mesh_file (name, data), embedded materials.
_NO_MESH = 2 * _EMPTY_TEXT + bytes(5)


def markers_bytes(header: Any, markers: Iterable[Marker]) -> bytes:
    """A serialised visualization_msgs/MarkerArray of `markers`, and of no older ones.

    `header` is a std_msgs/Header of rclpy or rosbags.
    """
    out = bytearray(_LITTLE_ENDIAN)
    drawn = [CLEAR, *markers]
    out += struct.pack('<I', len(drawn))
    stamp = struct.pack('<iI', header.stamp.sec, header.stamp.nanosec) + _text(header.frame_id)
    for marker in drawn:
        _align(out, 4)
        out += stamp
        _align(out, 4)
        out += _text(marker.namespace)
        _align(out, 4)
        out += struct.pack('<3i', marker.number, marker.kind, marker.action)
        _align(out, 8)
        unturned = (0.0, 0.0, 0.0, 1.0)
        out += _PLACED.pack(
            *marker.position, *unturned, *marker.scale, *marker.colour, 0, 0, False
        )
        _align(out, 4)
        out += struct.pack('<I', len(marker.points))
        if len(marker.points):
            _align(out, 8)
            out += np.ascontiguousarray(marker.points, '<f8').tobytes()
        out += _UNTEXTURED
        out += _text(marker.text)
        _align(out, 4)
        out += _NO_MESH
    return bytes(out)


def _text(text: str) -> bytes:
    data = text.encode() + b'\0'
    return struct.pack('<I', len(data)) + data


def _align(out: bytearray, size: int) -> None:
    out += bytes((len(_LITTLE_ENDIAN) - len(out)) % size)
