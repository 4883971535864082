"""What a frame was segmented with, and what came of it."""

from __future__ import annotations

from typing import Any

from rangeseg_ros.core.segmentation import Segmentation
from rangeseg_ros.messages.make import STATUS, Make

OK, WARN = 0, 1
"""diagnostic_msgs/DiagnosticStatus: levels."""


def status_message(make: Make, header: Any, result: Segmentation) -> Any:
    """diagnostic_msgs/DiagnosticArray of one frame, under its header.

    One status with the values `work_budget`, as many digits of it as give the same labels again,
    `planes`, their number, `reason` why there is none, `sensor`, and `input`, what is doubtful
    about the image, as `/diagnostics` has them.
    """
    values = {
        'work_budget': repr(result.work_budget),
        'planes': str(len(result.planes)),
        'reason': result.reason,
        'sensor': str(result.sensor),
        'input': str(result.verdict),
    }
    status = make(
        'diagnostic_msgs/msg/DiagnosticStatus',
        level=WARN if result.reason or not result.verdict.ok else OK,
        name='segmentation of a frame',
        message=result.reason or f'{len(result.planes)} planes',
        hardware_id='',
        values=[
            make('diagnostic_msgs/msg/KeyValue', key=key, value=value)
            for key, value in values.items()
        ],
    )
    return make(STATUS, header=header, status=[status])
