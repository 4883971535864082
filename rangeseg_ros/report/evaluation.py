"""The report of an evaluation: how the segmentations of a data set compare with its truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rangeseg_ros.core.config import Config
from rangeseg_ros.evaluation.figures import COUNTS
from rangeseg_ros.evaluation.measure import Measurement
from rangeseg_ros.report.page import Picture, common, spread, write_page

_KINDS = COUNTS[1:]


def write_evaluation(
    folder: Path,
    name: str,
    config: Config,
    found: Sequence[Measurement],
    figures: Mapping[str, Any],
) -> None:
    """Write report.html into the folder with the pictures of `Task`.

    Parameters
    ----------
    folder : Path
        Has <name>_classes.png of every image.
    name : str
        Of the data set.
    config : Config
        Parameters that were used.
    found : sequence of Measurement
        One or more.
    figures : mapping
        Of `evaluation_figures`.
    """
    tolerances = figures['tolerances']
    # One tolerance for the single images: that of their pictures where it is among them.
    shown = '0.8' if '0.8' in tolerances else next(iter(tolerances))
    images = {image: single['tolerances'][shown] for image, single in figures['per_image'].items()}
    timings = [item.timings for item in found]
    write_page(
        folder / 'report.html',
        'evaluation.html',
        name=name,
        method=config.method,
        tolerances=tolerances,
        kinds=_KINDS,
        shown=shown,
        images=images,
        pictures=spread(
            [
                Picture(
                    folder / f'{image}_classes.png',
                    f'{image}: {row["correct"]} of {row["regions"]} correct',
                )
                for image, row in images.items()
            ]
        ),
        **common(config, timings, Counter(item.reason for item in found if item.reason)),
    )
