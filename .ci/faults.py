#!/usr/bin/env python3
"""Faults of files, machines, arrays and messages, and what the package answers to each.

    .venv/bin/python .ci/faults.py [PATTERN]

Every case runs in a process and a folder of its own, and yields answers: `line` (one line on stderr
and an exit code), `right` (the right result), or what is wrong: `traceback`, `wrong`, `hang`,
`crash`. Prints those and a table of counts; the exit code is 1 if any is wrong.
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

ROOT = Path(__file__).parents[1]
sys.path[:0] = [os.fspath(ROOT), os.fspath(ROOT / 'test')]

from rangeseg_ros import Camera, RangeImage, segment  # noqa: E402
from rangeseg_ros.io.cameras import write_camera  # noqa: E402

RANGESEG = [sys.executable, '-c', 'from rangeseg_ros.start import rangeseg; rangeseg()']
CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
GOOD = 'line', 'right'
LIMIT = 150  # seconds for one command, on a machine that is busy
WALL = np.full((48, 64), 1500, np.uint16)
SEGMENT = ('segment', 'wall.png', '--camera', 'camera.yaml', '--output', 'out')
REPLAY = ('replay', 'bag', '--output', 'out')
CASES = {}


def case(function):
    """Register a case: a generator of (what, answer)."""
    CASES[function.__name__] = function
    return function


def start(*words, **options):
    """Start a command; its environment is that of here with what is given, None for nothing."""
    given = options.pop('env', {})
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path), **given}
    options['env'] = {name: value for name, value in environment.items() if value is not None}
    pipes = {'stdin': subprocess.DEVNULL, 'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE}
    command = [*options.pop('prefix', ()), *RANGESEG, *map(str, words)]
    return subprocess.Popen(command, **{**pipes, **options}, start_new_session=True)


def answer(process, right=lambda: True, codes=(0,)):
    """What became of a command: `right` is asked where it ends with one of `codes`."""
    try:
        _, error = process.communicate(timeout=LIMIT)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return 'hang'
    text = (error or b'').decode(errors='replace').strip()
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


def prepared():
    """Camera and image of a wall in the current folder."""
    write_camera(Path('camera.yaml'), CAMERA)
    cv2.imwrite('wall.png', WALL)


def recorded(path, count=4, storage='mcap', compression=None):
    """Record a wall, `compression` naming one of rosbags."""
    from recordings import Recording
    from rosbags import rosbag1, rosbag2

    recording = Recording(ros1=storage == 'rosbag1')
    for stamp in range(10**9, (count + 1) * 10**9, 10**9):
        recording.add_camera(stamp)
        noise = np.random.default_rng(stamp).integers(0, 9, WALL.shape, np.uint16)
        recording.add_image(stamp, WALL + noise)
    kind = rosbag1.Writer if recording.ros1 else rosbag2.Writer
    made = kind.__init__

    def compressed(writer, *given, **named):
        made(writer, *given, **named)
        if compression and recording.ros1:
            writer.set_compression(kind.CompressionFormat[compression])
        elif compression:
            mode = rosbag2.CompressionMode[compression.partition(' ')[2].upper()]
            writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)

    kind.__init__ = compressed
    try:
        return recording.write(Path(path), storage)
    finally:
        kind.__init__ = made


def labelled(count=1):
    """Whether so many label images are there, each with the wall."""
    found = [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in Path('out').rglob('*_labels.png')]
    return len(found) == count and all((image > 0).mean() > 0.9 for image in found)


# Files and the machine.


@case
def killed_processes():
    for name in 'abc':
        recorded(name, 60)
    words = ('replay', 'a', 'b', 'c', '--output', 'out', '--jobs', 2)

    def begun():
        end = time.monotonic() + LIMIT
        while len(list(Path('out').rglob('*_labels.png'))) < 3 and time.monotonic() < end:
            time.sleep(0.05)

    def children(parent):
        stats = [
            p.read_text().rpartition(')')[2].split() for p in Path('/proc').glob('[0-9]*/stat')
        ]
        ids = [p.parent.name for p in Path('/proc').glob('[0-9]*/stat')]
        return [int(i) for i, s in zip(ids, stats, strict=False) if int(s[1]) == parent]

    process = start(*words)
    begun()
    left = children(process.pid)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    time.sleep(12)
    alive = [i for i in left if Path(f'/proc/{i}').exists()]
    yield 'parent killed: workers end', 'right' if left and not alive else f'wrong: {alive}'
    process = start(*words)
    begun()
    for child in children(process.pid)[-1:]:
        os.kill(child, signal.SIGKILL)
    yield 'worker killed, after that', answer(process, lambda: labelled(180))


@case
def signals():
    recorded('bag', 300)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        process = start(*REPLAY)
        end = time.monotonic() + LIMIT
        while not list(Path('out').glob('*_labels.png')) and time.monotonic() < end:
            time.sleep(0.02)
        process.send_signal(number)
        yield number.name, answer(process, codes=(128 + number,))


@case
def full_disk():
    prepared()
    recorded('bag')
    for size in (0, 300, 3000):

        def limit(size=size):
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

        # A cache of kernels that cannot be written either.
        pack = ('pack', '.', '--camera', 'camera.yaml', '--output', f'packed{size}')
        simulate = ('simulate', 'kinect', '--scenes', 1, '--output', f'set{size}')
        for words in (SEGMENT, REPLAY, pack, simulate):
            yield f'{size} bytes: {words[0]}', told(*words, preexec_fn=limit)
    for words in (SEGMENT, REPLAY):
        yield f'/dev/full: {words[0]}', told(*words, '--overwrite', stdout=open('/dev/full', 'w'))


@case
def folders_and_links():
    prepared()
    recorded('bag')
    for target in ('/proc/none', '/dev/null/x', 'wall.png', 'wall.png/x', 'x' * 300):
        yield f'segment to {target[:20]}', told(*SEGMENT[:-1], target)
        yield f'replay to {target[:20]}', told(*REPLAY[:-1], target)
    os.symlink('loop', 'loop')
    yield 'loop of links', told(*SEGMENT[:-1], 'loop')
    os.symlink('nowhere', 'dangling.yaml')
    yield (
        'dangling link',
        told('segment', 'wall.png', '--camera', 'dangling.yaml', '--output', 'o'),
    )
    Path('out').mkdir()
    os.link('wall.png', 'out/wall_labels.png')
    same = lambda: (cv2.imread('wall.png', -1) == WALL).all()  # noqa: E731
    yield 'hard link of the input', told(*SEGMENT, '--overwrite', right=same)


@case
def pipes():
    prepared()
    os.mkfifo('pipe')
    os.mkfifo('pipe.png')
    recorded('bag')
    for words in (
        ('segment', 'pipe.png', '--camera', 'camera.yaml', '--output', 'out'),
        ('segment', 'wall.png', '--camera', 'pipe', '--output', 'out'),
        (*SEGMENT, '--params', 'pipe'),
        ('replay', 'pipe', '--output', 'out'),
        ('compare', 'wall.png', 'wall.png', '--json', 'pipe'),
        ('pack', '.', '--camera', 'camera.yaml', '--output', 'packed'),
    ):
        yield ' '.join(words[:3]), told(*words)


@case
def damaged_recordings():
    kinds = [('mcap', None), ('mcap', 'ZSTD storage'), ('mcap', 'ZSTD message')]
    kinds += [('mcap', 'ZSTD file'), ('sqlite3', None), ('sqlite3', 'ZSTD file')]
    kinds += [('rosbag1', name) for name in (None, 'BZ2', 'LZ4')]
    random = np.random.default_rng(5)
    for storage, compression in kinds:
        name = f'{storage} {compression or "plain"}'
        folder = Path(re.sub(r'\W', '_', name) + '.bag' * (storage == 'rosbag1'))
        try:
            recorded(folder, 6, storage, compression)
        except Exception as error:  # not every storage has every compression
            yield name, f'right: not written: {error}'
            continue
        parts = (
            [folder] if folder.is_file() else [p for p in folder.iterdir() if p.suffix != '.yaml']
        )
        (data,) = parts
        whole = data.read_bytes()
        words = ('replay', folder, '--output', 'out', '--overwrite')
        yield f'{name}, whole', told(*words)
        for what, content in (
            ('empty', b''),
            ('cut in the middle', whole[: len(whole) // 2]),
            ('last byte gone', whole[:-1]),
            ('noise', random.bytes(len(whole))),
            ('noise in the middle', whole[:900] + random.bytes(900) + whole[1800:]),
        ):
            data.write_bytes(content)
            yield f'{name}, {what}', told(*words, codes=(0, 1))
        data.write_bytes(whole)


@case
def declared_sizes():
    prepared()
    numpy_header = b"\x93NUMPY\x01\x00v\x00{'descr': '<u2', 'fortran_order': False, "
    header = (numpy_header + b"'shape': (99999999, 99999999), }").ljust(127) + b'\n'
    Path('a.npy').write_bytes(header)
    fields = 'FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 999999999\nHEIGHT 999999\nDATA binary\n'
    Path('a.pcd').write_text(fields)
    ply = 'ply\nformat ascii 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n'
    Path('a.ply').write_text(ply)
    png = Path('wall.png').read_bytes()
    Path('a.png').write_bytes(png[:16] + b'\x7f\xff\xff\xff' * 2 + png[24:])
    Path('a.tiff').write_bytes(
        b'II*\0\x08\0\0\0\xff\xff' + b'\0\1\4\0\1\0\0\0\xff\xff\xff\x7f' * 4
    )
    for suffix in ('npy', 'pcd', 'ply', 'png', 'tiff'):
        yield suffix, told('segment', f'a.{suffix}', '--fov', 60, '--output', 'out')


@case
def yaml_bombs():
    prepared()
    recorded('bag')
    grown = 'a: &a [1,1,1,1,1,1,1,1,1,1]\n' + ''.join(
        f'{b}: &{b} [{",".join([f"*{a}"] * 10)}]\n'
        for a, b in zip('abcdefg', 'bcdefgh', strict=True)
    )
    for what, text in (
        ('aliases', grown),
        ('itself', 'a: &a [*a, *a]'),
        ('deep', '[' * 30000),
        ('long', '[' + '1, ' * 2_000_000 + '1]'),
        ('bytes', 'a: \0\x01'),
    ):
        Path('bomb.yaml').write_text(text)
        yield f'{what}: camera', told(*SEGMENT[:3], 'bomb.yaml', *SEGMENT[4:])
        yield f'{what}: params', told(*SEGMENT, '--params', 'bomb.yaml')
        Path('bag/metadata.yaml').write_text(text)
        yield f'{what}: metadata', told(*REPLAY, '--overwrite', codes=(0, 1))


@case
def environments():
    prepared()
    none = {'HOME': None, 'XDG_CACHE_HOME': None}
    for what, env in (
        ('no HOME', none),
        ('HOME that is no folder', {'HOME': '/dev/null'}),
        ('no temporary folder', {'TMPDIR': '/none', 'TMP': '/none', 'TEMP': '/none'}),
        ('locale C', {'LC_ALL': 'C', 'LANG': 'C', 'PYTHONUTF8': '0', 'PYTHONCOERCECLOCALE': '0'}),
        ('a terminal of nothing', {'TERM': None, 'COLUMNS': '0'}),
    ):
        os.makedirs('ünï', exist_ok=True)
        cv2.imwrite('ünï/wall.png', WALL)
        words = ('segment', 'ünï', '--fov', 60, '--output', f'out/{what}')
        yield what, told(*words, env=env, right=lambda p=f'out/{what}': any(Path(p).iterdir()))
    for closed in ('0', '1', '2', '1 2', '0 1 2'):
        shell = ' '.join(f'{number}>&-' for number in closed.split())
        prefix = ['/bin/sh', '-c', f'exec "$@" {shell}', 'sh']
        code = told(*SEGMENT, '--overwrite', prefix=prefix, right=labelled)
        yield f'closed: {closed}', code


@case
def at_the_same_time():
    prepared()
    recorded('bag', 20)
    both = [start(*SEGMENT, '--overwrite') for _ in range(3)]
    for number, process in enumerate(both):
        yield f'segment {number}', answer(process, labelled)
    both = [start('replay', 'bag', '--output', 'again') for _ in range(2)]
    answers = sorted(answer(process) for process in both)
    yield 'two replays: one may write', answers[0] if answers[0] not in GOOD else answers[1]
    yield 'no scheduler', told(*REPLAY, '--overwrite', '--scheduler', 'tcp://127.0.0.1:9')


# Arrays.


def same(depth, camera=CAMERA, **more):
    """Answer of a call with an array: the labels of the wall, or an error of one line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            labels = segment(depth, camera, **more).labels
    except (ValueError, TypeError) as error:
        return 'line' if '\n' not in str(error) and str(error) else f'wrong: {error}'
    except Exception as error:
        return f'traceback: {error!r}'
    return 'right' if (labels == 1).all() else f'wrong: labels {np.unique(labels)}'


@case
def arrays():
    for code in '?bBhHiIlLqQefdgFDOSUmM':
        yield f'type {code}', same(WALL.astype('f8').astype('u2').astype(code, casting='unsafe'))
    wide = np.repeat(np.repeat(WALL, 2, 0), 2, 1)
    metres = WALL / 1000
    for what, array in (
        ('big-endian', WALL.astype('>u2')),
        ('big-endian floats', metres.astype('>f4')),
        ('strides', wide[::2, ::2]),
        ('backwards', WALL[::-1, ::-1]),
        ('columns first', np.asfortranarray(WALL)),
        ('one value', np.broadcast_to(np.uint16(1500), WALL.shape)),
        ('read only', np.frombuffer(WALL.tobytes(), np.uint16).reshape(WALL.shape)),
        ('unaligned', np.frombuffer(b'x' + metres.tobytes(), 'u1')[1:].view('f8').reshape(48, 64)),
        ('masked', np.ma.masked_equal(WALL, 0)),
        ('matrix', np.asmatrix(WALL)),
        ('record', WALL.view(np.recarray)),
        ('list', WALL.tolist()),
        ('nothing', np.zeros((0, 0), np.uint16)),
        ('no columns', np.zeros((48, 0), np.uint16)),
        ('a number', np.uint16(3)),
        ('row', WALL[0]),
        ('stack', WALL[None]),
        ('None', None),
        ('text', 'wall.png'),
        ('huge values', np.full(WALL.shape, 1e300)),
    ):
        yield what, same(array)
    hidden = np.ma.masked_array(WALL, WALL > 0)
    yield (
        'all masked',
        'right' if not RangeImage.from_depth(hidden, CAMERA).valid.any() else 'wrong',
    )


@case
def threads_and_processes():
    with ThreadPoolExecutor(8) as pool:
        yield '8 threads', max(pool.map(same, [WALL] * 64), key=len)

    async def gather():
        return await asyncio.gather(*(asyncio.to_thread(same, WALL) for _ in range(8)))

    yield 'asyncio', max(asyncio.run(gather()), key=len)
    for method in ('spawn', 'forkserver', 'fork'):
        context = multiprocessing.get_context(method)
        pool = context.Pool(2)
        try:
            yield method, max(pool.map_async(same, [WALL] * 4).get(LIMIT), key=len)
        except multiprocessing.TimeoutError:
            yield method, 'hang'
        pool.terminate()


# Messages.


@case
def node():
    try:
        from ros_bench import Bench, kinect_camera
    except ImportError as error:
        yield 'node', f'right: not tried: {error}'
        return
    nan = float('nan')
    with Bench() as bench, bench.listening('labels'), bench.camera_on():
        bench.in_use()

        def survives():
            return 'right' if bench.segment().any() else 'wrong: no labels'

        yield 'as it should be', survives()
        odd = {
            'step 0': {'step': 0},
            'step of 4 GB': {'step': 2**32 - 1},
            'width 0': {'width': 0},
            'height of 4 G': {'height': 2**32 - 1},
            'no data': {'data': bytes(0)},
            'encoding of 1 MB': {'encoding': 'x' * 2**20},
        }
        for what, fields in odd.items():
            bench.send(bench.image(**fields))
            yield what, survives()
        for what, values in (
            ('NaN', nan),
            ('infinite', float('inf')),
            ('0', 0.0),
            ('1e300', 1e300),
        ):
            k = [values, 0.0, 80.0, 0.0, values, 60.0, 0.0, 0.0, 1.0]
            bench.send(info=bench.info(k=k))
            yield f'intrinsics {what}', survives()
        image = bench.image()
        image.header.frame_id = 'x' * 2**20
        bench.send(image)
        yield 'frame id of 1 MB', survives()
        for seconds in (-(2**31), -1, 0, 2**31 - 1):
            image = bench.image()
            image.header.stamp.sec = seconds
            bench.send(image)
            yield f'stamp {seconds}', survives()
        bench.send(
            bench.image(np.zeros((4000, 4000), np.uint16)), bench.info(kinect_camera(4000, 4000))
        )
        yield 'an image of 16 megapixels', survives()
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
        for what, found in CASES[given.case]():
            print(f'{what}\t{found}', flush=True)
        return 0
    table = {}
    for name in (name for name in CASES if re.search(given.pattern, name)):
        with tempfile.TemporaryDirectory(prefix='faults-') as folder:
            command = [sys.executable, os.path.abspath(__file__), '--case', name]
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        found = [line.partition('\t')[::2] for line in done.stdout.splitlines() if '\t' in line]
        if done.returncode:
            last = (done.stderr.strip().splitlines() or [''])[-1]
            found.append(('the case', f'crash: exit code {done.returncode}, {last}'))
        table[name] = Counter(what.partition(':')[0] for _, what in found)
        for what, outcome in found:
            if outcome.partition(':')[0] not in GOOD:
                print(f'{name}, {what}: {outcome}', flush=True)
        print(
            f'{name:24}', ', '.join(f'{n} {kind}' for kind, n in table[name].items()), flush=True
        )
    total = sum(table.values(), Counter())
    print(f'{"all":24}', ', '.join(f'{count} {kind}' for kind, count in total.most_common()))
    return 1 if set(total) - set(GOOD) else 0


if __name__ == '__main__':
    sys.exit(main())
