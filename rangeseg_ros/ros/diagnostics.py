"""What becomes of the frames, in numbers and as a diagnostic status."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from threading import Lock

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from rangeseg_ros.ros.depth_input import DepthInput

WINDOW = 5.0
"""Seconds over which rates and losses are counted."""

LOSS_HINT = (
    'the middleware loses depth messages: images over 512 KiB do not fit the default '
    'shared-memory segment of Fast DDS; set FASTRTPS_DEFAULT_PROFILES_FILE to '
    'params/fastdds_large_images.xml of this package for publisher and node'
)


class Window:
    """Events of the last seconds; used by two threads."""

    def __init__(self) -> None:
        self.total = 0
        self._times: deque[float] = deque()
        self._lock = Lock()

    def add(self, count: int = 1) -> None:
        """Count events of now."""
        with self._lock:
            self.total += count
            self._times.extend([time.monotonic()] * count)

    def recent(self) -> int:
        """Number of events in the last `WINDOW` seconds."""
        with self._lock:
            while self._times and self._times[0] < time.monotonic() - WINDOW:
                self._times.popleft()
            return len(self._times)

    def rate(self) -> float:
        """Frequency of the events of the last `WINDOW` seconds, Hz."""
        count = self.recent()
        with self._lock:
            return (count - 1) / (self._times[-1] - self._times[0]) if count > 1 else 0.0


@dataclass(frozen=True)
class FrameTimes:
    """Where the time of a frame went, milliseconds.

    Attributes
    ----------
    transport : float
        Stamp of the depth message to its arrival.
    waiting : float
        Arrival to the start of the work: for camera_info, or for the frame before.
    conversion, compute, publication : float
        Message to range image, segmentation, and result to published messages.
    stages : dict
        Stages of the computation.
    """

    transport: float
    waiting: float
    conversion: float
    compute: float
    publication: float
    stages: dict[str, float] = field(default_factory=dict)

    @property
    def latency(self) -> float:
        """Stamp to the end of the publication."""
        return self.transport + self.waiting + self.conversion + self.compute + self.publication


class FrameStatistics:
    """Counts what becomes of the frames.

    Attributes
    ----------
    received, published, dropped, refused, lost : Window
        Frames that arrived complete; were segmented and published; were replaced by a newer
        one; could not be segmented; never arrived.
    problem : str
        Why the last frame could not be segmented; empty when it could.
    planes : int
        Number of planes in the last frame.
    reason : str
        Why there is none.
    times : FrameTimes or None
        Of the last frame.
    """

    def __init__(self) -> None:
        self.received, self.published, self.dropped = Window(), Window(), Window()
        self.refused, self.lost = Window(), Window()
        self.problem = ''
        self.planes = 0
        self.reason = ''
        self.times: FrameTimes | None = None

    def status(
        self, name: str, source: DepthInput | None, stall_timeout: float
    ) -> DiagnosticStatus:
        """Summary of now; `source` is None while nobody listens."""
        level, message = self._judge(source, stall_timeout)
        values = {
            'input rate (Hz)': f'{self.received.rate():.2f}',
            'output rate (Hz)': f'{self.published.rate():.2f}',
            'frames received': str(self.received.total),
            'frames published': str(self.published.total),
            'frames dropped for newer ones': str(self.dropped.total),
            'frames refused': str(self.refused.total),
            'messages lost by the middleware': str(self.lost.total),
            'planes': str(self.planes),
            'reason for no planes': self.reason,
        }
        if self.times:
            for part in ('latency', 'transport', 'waiting', 'conversion', 'compute'):
                values[f'{part} (ms)'] = f'{getattr(self.times, part):.2f}'
            for stage, milliseconds in self.times.stages.items():
                values[f'compute: {stage} (ms)'] = f'{milliseconds:.2f}'
            values['publication (ms)'] = f'{self.times.publication:.2f}'
        return DiagnosticStatus(
            level=level,
            name=f'{name}: segmentation',
            message=message,
            hardware_id=source.topic if source else '',
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )

    def _judge(self, source: DepthInput | None, stall_timeout: float) -> tuple[bytes, str]:
        if source is None:
            return DiagnosticStatus.OK, 'idle: nobody listens'
        silence = time.monotonic() - source.last_arrival
        if silence > stall_timeout:
            return DiagnosticStatus.ERROR, (
                f'no depth message on {source.topic} for {silence:.1f} s '
                f'({source.publishers} publishers)'
            )
        if problem := source.problem or self.problem:
            return DiagnosticStatus.ERROR, problem
        if lost := self.lost.recent():
            share = lost / (lost + self.received.recent())
            return DiagnosticStatus.WARN, f'{share:.0%} lost on {source.topic}: {LOSS_HINT}'
        if self.published.total and not self.planes:
            return DiagnosticStatus.WARN, f'no planes: {self.reason}'
        return DiagnosticStatus.OK, f'{self.planes} planes at {self.published.rate():.1f} Hz'
