"""The folder of a replay: what in it is the replay's own, and whether it is whole."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from zlib import crc32

from rangeseg_ros.batch.frame_files import FRAME_FILES
from rangeseg_ros.batch.result_bag import read_record
from rangeseg_ros.io.files import TEMPORARY, resolved
from rangeseg_ros.io.recordings import BagError, Recording

BAG = 'bag'
"""Name of the bag among the results."""
PICTURES = ('labels', 'overlay')
"""Which of `FRAME_FILES` every frame has."""
TERRAIN = ('terrain', 'height')
"""Which of them every frame has where terrain is asked for."""
LEADING = ('frame', 'stamp')
"""First columns of the table of planes."""

_ENDINGS = '|'.join(re.escape(FRAME_FILES[name].ending) for name in PICTURES + TERRAIN)
_OWN = re.compile(
    rf'\d{{6,}}_-?\d+\.\d{{9}}({_ENDINGS})|(planes|stairs|ground)\.csv|map\.(csv|ply)|'
    r'report\.html|trajectory\.txt'
)


class ResultFolder:
    """Where a replay leaves its results; it need not exist. The bag is there when all else is."""

    def __init__(self, path: Path) -> None:
        self.path, self.bag = path, path / BAG

    def check(self, recording: Path, overwrite: bool) -> None:
        """Raise BagError when something is there that is no replay's, and may not be replaced."""
        source = resolved(recording)
        if resolved(self.path) == source or resolved(self.bag) in (source, *source.parents):
            raise BagError(f'{self.bag}: exists already, not overwritten: it is the recording')
        if overwrite or read_record(self.bag):
            return
        for path in [self.bag, *self._own()]:
            if path.exists():
                raise BagError(f'{path}: exists already, not overwritten')

    @contextmanager
    def replacing(self) -> Iterator[ResultFolder]:
        """Give a folder for results, which take the place of earlier ones once all are there."""
        for left in self.path.glob(f'{TEMPORARY}*'):  # of a process that was killed
            if left.name.removeprefix(TEMPORARY).isdigit():
                shutil.rmtree(left, ignore_errors=True)
        unfinished = ResultFolder(self.path / f'{TEMPORARY}{os.getpid()}')
        unfinished.path.mkdir(parents=True)
        try:
            yield unfinished
            made = unfinished._own()
            for path in made:
                os.replace(path, self.path / path.name)
            for name in {path.name for path in self._own()} - {path.name for path in made}:
                (self.path / name).unlink()
            # The bag last: its record says that all else is there.
            if self.bag.exists():
                os.replace(self.bag, unfinished.path / 'before')
            os.replace(unfinished.bag, self.bag)
        finally:
            shutil.rmtree(unfinished.path, ignore_errors=True)

    def digest(self) -> str:
        """Of the names and contents of all results but the bag; of the report, its name alone.

        Times in the report differ in every run, and the bag holds this digest.
        """
        files = {
            path.name: b'' if path.suffix == '.html' else path.read_bytes() for path in self._own()
        }
        state = [(name, len(data), crc32(data)) for name, data in sorted(files.items())]
        return f'{crc32(repr(state).encode()):08x}'

    def whole(self) -> bool:
        """Whether all results are there as the bag's record says."""
        try:
            recording = Recording(self.bag)
            recording.close()
            return not recording.cut and read_record(self.bag).get('files') == self.digest()
        # Readers meet damaged bytes with exceptions of every kind.
        except Exception:
            return False

    def _own(self) -> list[Path]:
        """Files with the names of results."""
        if not self.path.is_dir():
            return []
        return [path for path in self.path.iterdir() if _OWN.fullmatch(path.name)]
