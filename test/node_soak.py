"""The node for as long as is asked for at 30 Hz: memory over time, and where every frame went.

    python test/node_soak.py FOLDER --minutes 60 --output soak.json

FOLDER holds depth images (16-bit PNG, millimetres) and camera.yaml. Not a test: it takes its time
and all of a computer. Listens to labels, planes and markers.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from array import array
from itertools import chain, cycle
from pathlib import Path

import cv2

PROFILE = Path(__file__).parents[1] / 'params' / 'fastdds_large_images.xml'
# Before the middleware is loaded.
os.environ.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE', os.fspath(PROFILE))

import rclpy  # noqa: E402
from rclpy.signals import SignalHandlerOptions  # noqa: E402
from ros_bench import DEPTH, INFO, RELIABLE, Bench, values_of  # noqa: E402
from sensor_msgs.msg import CameraInfo, Image  # noqa: E402

from rangeseg_ros.io.cameras import read_camera  # noqa: E402

RATE = 30.0
MIB = 2**20


def camera(folder, domain):
    """Publish the images to and fro until SIGTERM; print how many there were."""
    going = [True]
    signal.signal(signal.SIGTERM, lambda number, stack: going.clear())
    rclpy.init(domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node('camera')
    intrinsics = read_camera(folder / 'camera.yaml')
    images = node.create_publisher(Image, DEPTH, RELIABLE)
    infos = node.create_publisher(CameraInfo, INFO, RELIABLE)
    height, width = intrinsics.shape
    info = CameraInfo(height=height, width=width)
    info.k = [intrinsics.fx, 0.0, intrinsics.cx, 0.0, intrinsics.fy, intrinsics.cy, 0.0, 0.0, 1.0]
    message = Image(height=height, width=width, encoding='16UC1', step=2 * width)
    paths = sorted((folder / 'depth').glob('*.png')) or sorted(folder.glob('*.png'))
    pixels = [cv2.imread(os.fspath(path), cv2.IMREAD_UNCHANGED) for path in paths]
    data = [array('B', image.tobytes()) for image in pixels]
    while going and not (images.get_subscription_count() and infos.get_subscription_count()):
        time.sleep(0.05)
    time.sleep(1.0)
    due, sent = time.monotonic(), 0
    for part in cycle(chain(data, data[-2:0:-1])):
        if not going:
            break
        message.header.stamp = info.header.stamp = node.get_clock().now().to_msg()
        message.header.frame_id = info.header.frame_id = 'camera_depth_optical_frame'
        message.data = part
        infos.publish(info)
        images.publish(message)
        sent += 1
        due += 1 / RATE
        time.sleep(max(0.0, due - time.monotonic()))
    time.sleep(2.0)
    print(sent)


def resident(process):
    """Resident memory of a process, MiB."""
    pages = int(Path(f'/proc/{process}/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / MIB


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('folder', type=Path)
    parser.add_argument('--minutes', type=float, default=60)
    parser.add_argument('--output', type=Path)
    parser.add_argument('--camera', type=int, metavar='DOMAIN', help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.camera is not None:
        camera(arguments.folder, arguments.camera)
        return
    report = {'minutes': [], 'resident MiB': [], 'output Hz': [], 'latency ms': [], 'load': []}
    with Bench() as bench, bench.listening('labels', 'planes', 'markers'):
        command = [sys.executable, __file__, arguments.folder]
        command += ['--camera', os.environ['ROS_DOMAIN_ID']]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as source:
            start = time.monotonic()
            while (minutes := (time.monotonic() - start) / 60) < arguments.minutes:
                bench.spin(min(30.0, 60 * arguments.minutes / 10))
                values = values_of(bench.received['diagnostics'][-1].status[0])
                report['minutes'].append(round(minutes, 2))
                report['resident MiB'].append(round(resident(bench.process.pid), 1))
                report['output Hz'].append(values['output rate (Hz)'])
                report['latency ms'].append(values.get('latency (ms)'))
                report['load'].append(os.getloadavg()[0])
                for messages in bench.received.values():
                    del messages[:-1]
                if arguments.output:
                    arguments.output.write_text(json.dumps(report, indent=1))
            source.terminate()
            sent = int(source.stdout.read())
        bench.spin(3.0)
        values = values_of(bench.received['diagnostics'][-1].status[0])
        received, published, dropped, refused = (
            int(values[f'frames {what}'])
            for what in ('received', 'published', 'dropped for newer ones', 'refused')
        )
        unseen = int(values['messages lost or overwritten, by their numbers'])
        report['frames'] = {
            'sent': sent,
            'received': received,
            'lost or overwritten': unseen,
            'published': published,
            'dropped for newer ones': dropped,
            'refused': refused,
            'unaccounted': sent - unseen - published - dropped - refused,
        }
    print(json.dumps(report, indent=1))
    if arguments.output:
        arguments.output.write_text(json.dumps(report, indent=1))


if __name__ == '__main__':
    main()
