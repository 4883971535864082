"""What becomes of the frames, in numbers and as a diagnostic status."""

from __future__ import annotations

import time
from dataclasses import dataclass
from threading import get_ident

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.ros.counting import Losses, Window
from rangeseg_ros.ros.depth_input import DepthInput


@dataclass(frozen=True)
class FrameTimes:
    """Where the time of a frame went, milliseconds.

    Transport, from the stamp of the message to its arrival; waiting, to the start of the work: for
    camera_info, or for the frame before; conversion to a range image, computation, of which
    `stages` are parts, and publication.
    """

    transport: float
    waiting: float
    conversion: float
    compute: float
    publication: float
    stages: dict[str, float]

    def values(self, longest_transport: float) -> dict[str, str]:
        """Texts of the times, by name, as diagnostics show them.

        The transport is unknown where it exceeds `longest_transport`, ms: messages do not queue
        that long, so that stamps are of a recording or of another clock.
        """
        work = self.waiting + self.conversion + self.compute + self.publication
        times = {'latency since arrival': work}
        unknown = {}
        if abs(self.transport) <= longest_transport:
            times |= {'latency': self.transport + work, 'transport': self.transport}
        else:
            unknown = {'latency (ms)': 'unknown: the stamps are not of the clock of the node'}
        times |= {part: getattr(self, part) for part in ('waiting', 'conversion', 'compute')}
        times |= {f'compute: {stage}': time for stage, time in self.stages.items()}
        times['publication'] = self.publication
        return {f'{name} (ms)': f'{time:.2f}' for name, time in times.items()} | unknown


class Activity:
    """What threads are doing, and since when."""

    def __init__(self) -> None:
        self._doing: dict[int, tuple[float, str]] = {}

    def begin(self, what: str = '') -> None:
        """Note what this thread does from now on; nothing while it waits for a frame."""
        if what:
            self._doing[get_ident()] = time.monotonic(), what
        else:
            self._doing.pop(get_ident(), None)

    def __str__(self) -> str:
        now = time.monotonic()
        doing = sorted(self._doing.copy().values())
        return ', '.join(f'{what} for {now - since:.1f} s' for since, what in doing)


class FrameStatistics:
    """Counts what becomes of the frames, and keeps what is told of the last one.

    `received` arrived complete, `dropped` were replaced by a newer one, `refused` could not be
    segmented, of which `problem` says why. `sources` tells what up, the frames and the map come
    from, `missing` which frames were not known, `no_terrain` why up is not. Empty where there is
    nothing to tell.
    """

    def __init__(self) -> None:
        self.received, self.published = Window(), Window()
        self.dropped, self.refused = Window(), Window()
        self.losses = Losses()
        self.activity = Activity()
        self.compiling = ''
        self.pending = False
        self.problem = self.missing = self.no_terrain = ''
        self.sources: dict[str, str] = {}
        self.found: Segmentation | None = None
        self.times: FrameTimes | None = None
        self._unanswered: float | None = None

    def accepted(self, replaced: int) -> None:
        """Count a frame that arrived, and those that it replaced."""
        self.received.add()
        if replaced:
            self.dropped.add(replaced)
        if self._unanswered is None:
            self._unanswered = time.monotonic()

    def answered(self, counter: Window) -> None:
        """Count a frame that the worker is done with: published or refused."""
        counter.add()
        self._unanswered = None

    def done(self, found: Segmentation, times: FrameTimes) -> None:
        """Count a frame that is published."""
        self.found, self.times = found, times
        self.answered(self.published)

    def stalled(self) -> float:
        """Seconds since the first frame to which there was no answer yet; 0 when there is none."""
        since = self._unanswered
        return 0.0 if since is None else time.monotonic() - since

    def status(
        self, name: str, source: DepthInput | None, stall_timeout: float
    ) -> DiagnosticStatus:
        """Summary of now; `source` is None while nobody listens."""
        level, message = self._judge(source, stall_timeout)
        found = self.found
        unseen = self.losses.unseen
        # Only what was worked out for a listener.
        known = vars(found) if found else {}
        values = {
            'input rate (Hz)': f'{self.received.rate():.2f}',
            'output rate (Hz)': f'{self.published.rate():.2f}',
            'frames received': str(self.received.total),
            'frames published': str(self.published.total),
            'frames dropped for newer ones': str(self.dropped.total),
            'frames refused': str(self.refused.total),
            'messages lost by the middleware': str(self.losses.lost.total),
            'loss reports of impossible size': str(self.losses.implausible),
            'messages lost or overwritten, by their numbers': (
                'unknown' if unseen is None else str(unseen)
            ),
            'camera_info': source.pairing if source else '',
            'doing': self.doing() or 'waiting for a frame',
            'parameters': 'compiling, former ones in use' if self.pending else 'in use',
            **{f'{what} from': source for what, source in self.sources.items()},
            'input': str(found.verdict) if found else '',
            'planes': str(len(found.planes)) if found else '0',
            'reason for no planes': found.reason if found else '',
            'sensor': str(found.sensor) if found else '',
            'work_budget': f'{found.work_budget:g}' if found else '1',
            'ground': str(known.get('ground') or ''),
            'stairs': ', '.join(map(str, known.get('stairs', ()))),
        }
        if self.times:
            values.update(self.times.values(1000 * stall_timeout))
        return DiagnosticStatus(
            level=level,
            name=f'{name}: segmentation',
            message=message,
            hardware_id=source.topic if source else '',
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )

    def doing(self) -> str:
        """What the threads are at; empty while they wait."""
        parts = self.compiling, str(self.activity)
        return ', '.join(part for part in parts if part)

    def silence(self, source: DepthInput, stall_timeout: float) -> str:
        """For how long nothing has come from `source`; empty up to `stall_timeout` seconds."""
        silence = time.monotonic() - source.last_arrival
        if silence <= stall_timeout:
            return ''
        publishers = source.subscription.publishers()
        return f'no depth message on {source.topic} for {silence:.1f} s ({publishers})'

    def lost(self, source: DepthInput) -> str:
        """What share of the messages of `source` is lost, and what may help; empty when none."""
        lost = self.losses.lost.recent()
        if not lost:
            return ''
        share = lost / (lost + self.received.recent())
        hint = source.loss_hint()
        return f'{share:.0%} lost on {source.topic}' + (f': {hint}' if hint else '')

    def _judge(self, source: DepthInput | None, stall_timeout: float) -> tuple[bytes, str]:
        if source is None:
            busy = f'; {self.compiling}' if self.compiling else ''
            return DiagnosticStatus.OK, f'idle: nobody listens{busy}'
        error, warning = DiagnosticStatus.ERROR, DiagnosticStatus.WARN
        lost, found, stalled = self.lost(source), self.found, self.stalled()
        silence = self.silence(source, stall_timeout)
        no_output = f'no output for {stalled:.1f} s: {self.doing()}'
        problems = [
            (error, '; '.join(filter(None, (lost, silence))) if silence else ''),
            (error, source.problem or self.problem),
            (error, str(found.verdict) if found and found.verdict.invalid else ''),
            (error, no_output if stalled > stall_timeout else ''),
            (warning, self.compiling),
            (warning, lost),
            (error, self.no_terrain),
            (warning, self.missing),
            (warning, str(found.verdict) if found and not found.verdict.ok else ''),
            (warning, f'no planes: {found.reason}' if found and not found.planes else ''),
        ]
        count = len(found.planes) if found else 0
        fine = DiagnosticStatus.OK, f'{count} planes at {self.published.rate():.1f} Hz'
        return next((problem for problem in problems if problem[1]), fine)
