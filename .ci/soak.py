"""The node for as long as is asked for at 30 Hz: memory over time, and where every frame went.

    .venv/bin/python .ci/soak.py --minutes 60 --size 320 240 --output soak.json

Not a test: it takes its time and all of a computer. Listeners of every output come and go.
"""

import argparse
import json
import os
import random
import sys
import time
from contextlib import ExitStack
from pathlib import Path

PROFILE = Path(__file__).parents[1] / 'params' / 'fastdds_large_images.xml'
# Before the middleware is loaded.
os.environ.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE', os.fspath(PROFILE))
sys.path.insert(0, os.fspath(Path(__file__).parents[1] / 'test'))

from ros_bench import TYPES, Bench, values_of  # noqa: E402

from rangeseg_ros.simulation.render import simulate  # noqa: E402
from rangeseg_ros.simulation.scenes import kinect_room  # noqa: E402
from rangeseg_ros.simulation.sensors.kinect import Kinect, kinect_camera  # noqa: E402

RATE, FRAMES = 30.0, 20


def state(process):
    """Resident memory, MiB, threads and open files of a process."""
    folder = Path(f'/proc/{process}')
    pages = int((folder / 'statm').read_text().split()[1])
    return {
        'resident MiB': round(pages * os.sysconf('SC_PAGE_SIZE') / 2**20, 1),
        'threads': len(list((folder / 'task').iterdir())),
        'files': len(list((folder / 'fd').iterdir())),
    }


def main():
    """Publish, look every half minute, and write what is seen."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--minutes', type=float, default=60)
    parser.add_argument('--size', type=int, nargs=2, default=(640, 480), help='of the images')
    parser.add_argument('--output', type=Path)
    arguments = parser.parse_args()
    camera, draw, report = kinect_camera(*arguments.size), random.Random(0), []
    room = kinect_room(0, FRAMES)
    depths = [simulate(room, Kinect(0), camera, frame=k, seed=k).depth for k in range(FRAMES)]
    begin, sent = time.monotonic(), 0
    due = begin
    with Bench(camera=camera) as bench, bench.listening('labels'), bench.camera_on():
        while (minutes := (time.monotonic() - begin) / 60) < arguments.minutes:
            with ExitStack() as stack:
                stack.enter_context(bench.listening(*draw.sample(sorted(TYPES), 3)))
                until = time.monotonic() + 30
                while time.monotonic() < until:
                    bench.send(bench.image(depths[sent % FRAMES]))
                    sent += 1
                    due = max(due + 1 / RATE, time.monotonic() - 1)
                    bench.spin(max(due - time.monotonic(), 0))
                values = values_of(bench.received['diagnostics'][-1].status[0])
            counts = {name: values[name] for name in values if name.startswith(('frames', 'mess'))}
            report.append({'minutes': minutes, 'sent': sent, **state(bench.process.pid), **counts})
            for messages in bench.received.values():
                del messages[:-1]
            if arguments.output:
                arguments.output.write_text(json.dumps(report, indent=1))
    print(json.dumps(report[-1], indent=1))


if __name__ == '__main__':
    main()
