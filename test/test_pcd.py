"""PCD files: the three encodings, LZF by hand, malformed files, and real ones where they are."""

import contextlib
import struct

import numpy as np
import pytest
from dataset_files import literal_lzf
from hypothesis import given
from hypothesis import strategies as st

from rangeseg_ros.io.files import FileError
from rangeseg_ros.io.pcd import lzf_decompress, read_pcd

HEADER = """# .PCD v0.7
VERSION 0.7
FIELDS x label normal
SIZE 4 2 8
TYPE F U F
COUNT 1 1 3
WIDTH 3
HEIGHT 2
VIEWPOINT 0 0 0 1 0 0 0
POINTS 6
DATA {}
"""
X = np.array([[0.5, np.nan, 2], [3, 4, 5]], np.float32)
LABEL = np.array([[0, 1, 65535], [3, 4, 5]], np.uint16)
NORMAL = np.arange(18, dtype=float).reshape(2, 3, 3)


def records():
    dtype = np.dtype([('x', '<f4'), ('label', '<u2'), ('normal', '<f8', (3,))])
    array = np.zeros((2, 3), dtype)
    array['x'], array['label'], array['normal'] = X, LABEL, NORMAL
    return array


def encoded(kind):
    head = HEADER.format(kind).encode()
    array = records()
    if kind == 'ascii':
        rows = (f'{r["x"]} {r["label"]} {" ".join(map(str, r["normal"]))}' for r in array.ravel())
        return head + '\n'.join(rows).encode()
    if kind == 'binary':
        return head + array.tobytes()
    raw = b''.join(array[name].tobytes() for name in array.dtype.names)
    packed = literal_lzf(raw)
    return head + struct.pack('<II', len(packed), len(raw)) + packed


@pytest.mark.parametrize('kind', ['ascii', 'binary', 'binary_compressed'])
def test_encodings(tmp_path, kind):
    path = tmp_path / 'a.pcd'
    path.write_bytes(encoded(kind))
    fields = read_pcd(path)
    assert list(fields) == ['x', 'label', 'normal']
    assert np.array_equal(fields['x'], X, equal_nan=True) and fields['x'].dtype == np.float32
    assert np.array_equal(fields['label'], LABEL) and fields['label'].dtype == np.uint16
    assert np.array_equal(fields['normal'], NORMAL)


def test_lzf_by_hand():
    # Literal 'abc'; then 4 bytes from 3 back: 'abca'.
    assert lzf_decompress(b'\x02abc' + bytes([2 << 5, 2]), 7) == b'abcabca'
    # Literal 'x'; then 7 + 3 + 2 = 12 bytes from 1 back: a run.
    assert lzf_decompress(b'\x00x' + bytes([7 << 5, 3, 0]), 13) == b'x' * 13


@given(st.binary(max_size=60))
def test_damaged_lzf_is_refused(data):
    with contextlib.suppress(FileError):
        assert len(lzf_decompress(data, 40)) == 40


@pytest.mark.parametrize(
    ('change', 'fault'),
    [
        (lambda d: b'', 'no DATA'),
        (lambda d: d.replace(b'FIELDS', b'FEELDS'), 'lacks FIELDS'),
        (lambda d: d.replace(b'COUNT 1 1 3', b'COUNT 1 3'), 'malformed'),
        (lambda d: d.replace(b'x label normal', b'x x normal'), 'malformed'),
        (lambda d: d.replace(b'SIZE 4 2 8', b'SIZE 4 3 8'), 'malformed'),
        (lambda d: d.replace(b'TYPE F U F', b'TYPE F Q F'), 'malformed'),
        (lambda d: d.replace(b'WIDTH 3', b'WIDTH three'), 'malformed'),
        (lambda d: d.replace(b'WIDTH 3', b'WIDTH 0'), 'empty'),
        (lambda d: d.replace(b'DATA binary', b'DATA zipped'), 'unknown DATA'),
        (lambda d: d[:-1], 'truncated'),
        (lambda d: d.replace(b'WIDTH 3', b'WIDTH 10000000000'), 'truncated'),
        (lambda d: d.replace(b'COUNT 1 1 3', b'COUNT 1 1 99999999999'), 'malformed'),
        (lambda d: d.replace(b'COUNT 1 1 3', b'COUNT 1 1 ' + b'9' * 5000), 'malformed'),
        (lambda d: encoded('ascii')[:-4], 'malformed'),
        (lambda d: encoded('binary_compressed')[:-5], 'truncated'),
        (lambda d: HEADER.format('binary_compressed').encode() + bytes(4), 'malformed'),
    ],
)
def test_malformed(tmp_path, change, fault):
    path = tmp_path / 'bad.pcd'
    path.write_bytes(change(encoded('binary')))
    # The folder has the name of the test: words of it prove nothing.
    with pytest.raises(FileError, match=rf'^{path}: .*{fault}') as error:
        read_pcd(path)
    assert '\n' not in str(error.value)
