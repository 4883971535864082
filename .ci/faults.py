#!/usr/bin/env python3
"""Faults of files, machines, arrays and messages, and what the package answers to each.

    .venv/bin/python .ci/faults.py [PATTERN]

Every case runs in a process and a folder of its own, and yields answers: `line` (one line on
stderr and an exit code), `right` (the right result), or what is wrong: `traceback`, `wrong`,
`hang`, `crash`. Prints those and a table of counts; the exit code is 1 if any is wrong.
"""

from __future__ import annotations

import argparse
import asyncio
import multiprocessing
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2

ROOT = Path(__file__).parents[1]
sys.path[:0] = [os.fspath(ROOT), os.fspath(ROOT / 'test')]

from recordings import Recording  # noqa: E402

from rangeseg_ros import Camera, segment  # noqa: E402
from rangeseg_ros.io.cameras import write_camera  # noqa: E402

COMPRESSIONS = {kind.name: [kind] for kind in rosbag1.Writer.CompressionFormat}
COMPRESSIONS |= {k.name: [k, rosbag2.CompressionFormat.ZSTD] for k in rosbag2.CompressionMode}
RANGESEG = [sys.executable, '-c', 'from rangeseg_ros.start import rangeseg; rangeseg()']
CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
WALL = np.full((48, 64), 1500, np.uint16)
SEGMENT = ('segment', 'wall.png', '--camera', 'camera.yaml', '--output', 'out', '--overwrite')
REPLAY = ('replay', 'bag', '--output', 'out', '--overwrite')
GOOD = 'line', 'right'
LIMIT = 150  # seconds for one command, on a machine that is busy
CASES = {}


def case(function):
    """Register a case: a generator of (what, answer)."""
    CASES[function.__name__] = function
    return function


def start(*words, env=None, prefix=(), **options):
    """Start a command; its environment is that of here with what is given, None for nothing."""
    given = {**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path), **(env or {})}
    given = {name: value for name, value in given.items() if value is not None}
    options = {'stdin': subprocess.DEVNULL, 'stdout': subprocess.PIPE, **options}
    options |= {'stderr': subprocess.PIPE, 'start_new_session': True}
    return subprocess.Popen([*prefix, *RANGESEG, *map(str, words)], env=given, **options)


def answer(process, right=lambda: True, codes=(0,)):
    """What became of a command: `right` is asked where it ends with one of `codes`."""
    try:
        _, error = process.communicate(timeout=LIMIT)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return 'hang'
    text = error.decode(errors='replace').strip()
    if 'Traceback' in text:
        return 'traceback: ' + text.splitlines()[-1]
    if process.returncode < 0:
        return f'crash: signal {-process.returncode}'
    if process.returncode in codes and right():
        return 'right'
    lines = [line for line in text.splitlines() if not line.startswith('rangeseg: warning')]
    one_line = process.returncode and len(lines) == 1 and lines[0].startswith('rangeseg: ')
    return 'line' if one_line else f'wrong: exit code {process.returncode}, {text[:300]!r}'


def told(*words, right=lambda: True, codes=(0,), **options):
    """Run a command to its answer."""
    return answer(start(*words, **options), right, codes)


def recorded(path, count=4, storage='mcap', compression=None):
    """Record a wall; the file of a new recording."""
    recording = Recording(ros1=storage == 'rosbag1')
    for stamp in range(10**9, (count + 1) * 10**9, 10**9):
        noise = np.random.default_rng(stamp).integers(0, 9, WALL.shape, np.uint16)
        recording.add_camera(stamp)
        recording.add_image(stamp, WALL + noise)
    return recording.write(Path(path), storage, compression and COMPRESSIONS[compression])


def labelled():
    """Whether label images are there, each with the wall."""
    found = [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in Path('out').rglob('*_labels.png')]
    return bool(found) and all((image > 0).mean() > 0.9 for image in found)


@case
def killed_parent():
    for name in 'ab':
        recorded(name, 300)
    process = start('replay', 'a', 'b', '--output', 'out', '--jobs', 2)
    end = time.monotonic() + LIMIT
    while len(list(Path('out').rglob('*_labels.png'))) < 3 and time.monotonic() < end:
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    # Workers hold the pipe of the parent's errors open.
    yield 'workers end', 'hang' if answer(process) == 'hang' else 'right'
    yield 'again', told('replay', 'a', 'b', '--output', 'out', '--jobs', 2, right=labelled)


@case
def full_disk():
    recorded('bag')
    pack = ('pack', '.', '--camera', 'camera.yaml', '--output', 'packed')
    simulate = ('simulate', 'kinect', '--scenes', 1, '--output', 'set')
    for size in (0, 300, 3000):

        def limit(size=size):
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

        for words in (SEGMENT, REPLAY, pack, simulate):
            yield f'{size} bytes: {words[0]}', told(*words, preexec_fn=limit)
    with open('/dev/full', 'w') as full:
        for words in (SEGMENT, REPLAY):
            yield f'/dev/full: {words[0]}', told(*words, stdout=full)


@case
def folders_and_links():
    recorded('bag')
    os.symlink('loop', 'loop')
    for target in ('/proc/none', '/dev/null/x', 'wall.png', 'wall.png/x', 'x' * 300, 'loop'):
        yield f'segment to {target[:20]}', told(*SEGMENT, '--output', target)
        yield f'replay to {target[:20]}', told(*REPLAY, '--output', target)
    os.symlink('nowhere', 'dangling.yaml')
    yield 'dangling link', told(*SEGMENT, '--camera', 'dangling.yaml')
    Path('out').mkdir()
    os.link('wall.png', 'out/wall_labels.png')
    kept = told(*SEGMENT, right=lambda: (cv2.imread('wall.png', -1) == WALL).all())
    yield 'hard link of the input', kept


@case
def pipes():
    os.mkfifo('pipe')
    os.mkfifo('pipe.png')
    yield 'image', told(*SEGMENT, 'pipe.png')
    yield 'camera', told(*SEGMENT, '--camera', 'pipe')
    yield 'parameters', told(*SEGMENT, '--params', 'pipe')
    yield 'recording', told(*REPLAY, 'pipe')
    yield 'figures', told('compare', 'wall.png', 'wall.png', '--json', 'pipe')
    yield 'folder', told('pack', '.', '--camera', 'camera.yaml', '--output', 'packed')


@case
def damaged_recordings():
    kinds = [('mcap', kind) for kind in (None, 'STORAGE', 'MESSAGE', 'FILE')]
    kinds += [('sqlite3', kind) for kind in (None, 'MESSAGE', 'FILE')]
    kinds += [('rosbag1', kind) for kind in (None, 'BZ2', 'LZ4')]
    random = np.random.default_rng(5)
    for storage, compression in kinds:
        name = f'{storage}_{compression}'
        recording = Path(name + '.bag' * (storage == 'rosbag1'))
        data = recorded(recording, 6, storage, compression)
        whole = data.read_bytes()
        contents = {'whole': whole, 'empty': b'', 'without its last byte': whole[:-1]}
        contents |= {'half': whole[: len(whole) // 2], 'noise': random.bytes(len(whole))}
        contents |= {'noise in the middle': whole[:900] + random.bytes(900) + whole[1800:]}
        for what, content in contents.items():
            data.write_bytes(content)
            codes = (0,) if what == 'whole' else (0, 1)
            words = ('replay', recording, '--output', 'out', '--overwrite')
            yield f'{name}, {what}', told(*words, codes=codes)


@case
def declared_sizes():
    shape = b"{'descr': '<u2', 'fortran_order': False, 'shape': (99999999, 99999999), }"
    Path('a.npy').write_bytes(b'\x93NUMPY\x01\x00v\x00' + shape.ljust(117) + b'\n')
    fields = 'FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 999999999\nHEIGHT 999999\n'
    Path('a.pcd').write_text(fields + 'POINTS 999998999000001\nDATA binary\n')
    Path('a.ply').write_text('ply\nformat ascii 1.0\nelement vertex 99999999999\nend_header\n')
    png = Path('wall.png').read_bytes()
    Path('a.png').write_bytes(png[:16] + b'\x7f\xff\xff\xff' * 2 + png[24:])
    Path('a.tiff').write_bytes(
        b'II*\0\x08\0\0\0\xff\xff' + b'\0\1\4\0\1\0\0\0\xff\xff\xff\x7f' * 4
    )
    for suffix in ('npy', 'pcd', 'ply', 'png', 'tiff'):
        yield suffix, told('segment', f'a.{suffix}', '--fov', 60, '--output', 'out')


@case
def yaml_bombs():
    recorded('bag')
    pairs = zip('abcdefg', 'bcdefgh', strict=True)
    grown = ''.join(f'{new}: &{new} [{",".join([f"*{old}"] * 10)}]\n' for old, new in pairs)
    bombs = {'aliases': 'a: &a [1,1,1,1,1,1,1,1,1,1]\n' + grown, 'itself': 'a: &a [*a, *a]'}
    bombs |= {'deep': '[' * 30000, 'long': '[' + '1, ' * 2_000_000 + '1]', 'bytes': 'a: \0'}
    for what, text in bombs.items():
        Path('bomb.yaml').write_text(text)
        yield f'{what}: camera', told(*SEGMENT, '--camera', 'bomb.yaml')
        yield f'{what}: parameters', told(*SEGMENT, '--params', 'bomb.yaml')
        Path('bag/metadata.yaml').write_text(text)
        yield f'{what}: metadata', told(*REPLAY, codes=(0, 1))


@case
def environments():
    os.makedirs('ünï')
    os.rename('wall.png', 'ünï/wall.png')
    words = ('segment', 'ünï', '--fov', 60, '--output', 'out', '--overwrite')
    nowhere = dict.fromkeys(('TMPDIR', 'TMP', 'TEMP'), '/none')
    coding = {'LC_ALL': 'C', 'PYTHONUTF8': '0', 'PYTHONCOERCECLOCALE': '0'}
    homes = {'no HOME': {'HOME': None}, 'HOME that is no folder': {'HOME': '/dev/null'}}
    for what, env in (homes | {'no temporary folder': nowhere, 'locale C': coding}).items():
        yield what, told(*words, env=env, right=labelled)
    for closed in ('0<&-', '1>&-', '2>&-', '1>&- 2>&-', '0<&- 1>&- 2>&-'):
        prefix = ['/bin/sh', '-c', f'exec "$@" {closed}', 'sh']
        yield f'closed: {closed}', told(*words, prefix=prefix, right=labelled)


@case
def at_the_same_time():
    recorded('bag', 20)
    for process in [start(*SEGMENT) for _ in range(3)]:
        yield 'segment', answer(process, labelled)
    for process in [start('replay', 'bag', '--output', 'again') for _ in range(2)]:
        yield 'replay', answer(process)
    yield 'no scheduler', told(*REPLAY, '--scheduler', 'tcp://127.0.0.1:9')


def same(depth):
    """Answer of a call with an array: the labels of the wall, or an error of one line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            labels = segment(depth, CAMERA).labels
    except (ValueError, TypeError) as error:
        return 'line' if str(error) and '\n' not in str(error) else f'wrong: {error!r}'
    except Exception as error:
        return f'traceback: {error!r}'
    return 'right' if (labels == 1).all() else f'wrong: labels {np.unique(labels)}'


@case
def arrays():
    metres = WALL / 1000
    for code in 'BHILQhilqefdg?FDOSUmM':
        yield f'type {code}', same((metres if code in 'efdg' else WALL).astype(code))
    wide = np.repeat(np.repeat(WALL, 2, 0), 2, 1)
    unaligned = np.frombuffer(b'x' + metres.tobytes(), 'f8', offset=1).reshape(48, 64)
    read_only = np.frombuffer(WALL.tobytes(), np.uint16).reshape(48, 64)
    odd = {'big-endian': WALL.astype('>u2'), 'big-endian floats': metres.astype('>f4')}
    odd |= {'strides': wide[::2, ::2], 'backwards': WALL[::-1, ::-1], 'unaligned': unaligned}
    odd |= {'columns first': np.asfortranarray(WALL), 'read only': read_only}
    odd |= {'one value': np.broadcast_to(np.uint16(1500), WALL.shape), 'list': WALL.tolist()}
    odd |= {'masked': np.ma.masked_equal(WALL, 0), 'matrix': np.asmatrix(WALL), 'row': WALL[0]}
    odd |= {'nothing': np.zeros((0, 0), 'u2'), 'no columns': np.zeros((48, 0), 'u2')}
    odd |= {'a number': np.uint16(3), 'stack': WALL[None], 'None': None, 'text': 'wall.png'}
    for what, array in odd.items():
        yield what, same(array)


@case
def threads_and_processes():
    with ThreadPoolExecutor(8) as pool:
        yield '8 threads', max(pool.map(same, [WALL] * 64), key=len)

    yield 'asyncio', asyncio.run(asyncio.to_thread(same, WALL))
    for method in ('spawn', 'forkserver', 'fork'):
        with multiprocessing.get_context(method).Pool(2) as pool:
            yield method, max(pool.map_async(same, [WALL] * 4).get(LIMIT), key=len)


@case
def node():
    from ros_bench import Bench

    with Bench() as bench, bench.listening('labels'), bench.camera_on():
        bench.in_use()

        def survives():
            return 'right' if bench.segment().any() else 'wrong: no labels'

        for name, value in (('step', 0), ('step', 2**32 - 1), ('width', 0), ('height', 2**32 - 1)):
            bench.send(bench.image(**{name: value}))
            yield f'{name} {value}', survives()
        bench.send(bench.image(encoding='x' * 2**20))
        yield 'encoding of 1 MB', survives()
        for focal in (float('nan'), float('inf'), 0.0, 1e300):
            k = [focal, 0.0, 80.0, 0.0, focal, 60.0, 0.0, 0.0, 1.0]
            bench.send(info=bench.info(k=k))
            yield f'focal length {focal}', survives()
        for frame, seconds in (('x' * 2**20, 1), ('', -(2**31)), ('', 0), ('', 2**31 - 1)):
            image = bench.image()
            image.header.frame_id, image.header.stamp.sec = frame, seconds
            bench.send(image)
            yield f'frame id of {len(frame)}, stamp {seconds}', survives()
        os.kill(bench.process.pid, signal.SIGSTOP)
        for _ in range(100):
            bench.send()
        time.sleep(3)
        os.kill(bench.process.pid, signal.SIGCONT)
        yield 'stopped for 3 s', survives()
        for _ in range(500):
            bench.send()
        yield 'flood of 500', survives()


def main():
    """Run the cases whose names a pattern is found in; with --case one of them, here."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('pattern', nargs='?', default='')
    parser.add_argument('--case', choices=CASES)
    given = parser.parse_args()
    if given.case:
        write_camera(Path('camera.yaml'), CAMERA)
        cv2.imwrite('wall.png', WALL)
        for what, found in CASES[given.case]():
            print(f'{what}\t{found}', flush=True)
        return 0
    start('compile').communicate()  # which would take the time of the first case
    total = Counter()
    for name in (name for name in CASES if re.search(given.pattern, name)):
        with tempfile.TemporaryDirectory(prefix='faults-') as folder:
            command = [sys.executable, os.path.abspath(__file__), '--case', name]
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        found = [line.partition('\t')[::2] for line in done.stdout.splitlines() if '\t' in line]
        if done.returncode:
            found.append(('the case', f'crash: {done.returncode}, {done.stderr[-200:]!r}'))
        for what, outcome in found:
            if outcome not in GOOD:
                print(f'{name}, {what}: {outcome}', flush=True)
        counts = Counter(outcome.partition(':')[0] for _, outcome in found)
        print(f'{name:24}', ', '.join(f'{n} {kind}' for kind, n in counts.items()), flush=True)
        total += counts
    print(f'{"all":24}', ', '.join(f'{n} {kind}' for kind, n in total.most_common()))
    return bool(set(total) - set(GOOD))


if __name__ == '__main__':
    sys.exit(main())
