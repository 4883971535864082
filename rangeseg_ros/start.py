"""Entry points of the executables: until they have a handler of their own, Ctrl-C just ends them.

What they import takes a second or more, in which Python would answer with a traceback.
"""

import os
import signal
import sys

for number, name in enumerate(('stdin', 'stdout', 'stderr')):
    # Else a file that is written gets the number of a closed stream, and all that is printed.
    if getattr(sys, name) is None:
        stream = os.open(os.devnull, os.O_RDWR)  # the lowest number that is free: this one
        setattr(sys, name, open(stream, 'w' if number else 'r'))  # noqa: SIM115

# Frames are worked on in parallel already; threads of the linear algebra would spin beside that.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, lambda number, stack: os._exit(130))


def rangeseg() -> None:
    """Run the command line."""
    from rangeseg_ros.cli.main import main

    main()


def segment_planes() -> None:
    """Run the node."""
    try:
        from rangeseg_ros.ros.memory import use_one_arena

        use_one_arena()  # before rclpy starts its threads
        from rangeseg_ros.ros.node import main
    except ModuleNotFoundError as error:
        if error.name != 'rclpy':
            raise
        needed = 'source a ROS 2 installation, or install the extra jazzy'
        print(f'segment_planes: no rclpy: {needed}', file=sys.stderr)
        sys.exit(2)
    except OSError as error:  # nowhere to keep compiled kernels
        print(f'segment_planes: {error}', file=sys.stderr)
        sys.exit(2)
    main()
