"""The folder of a replay: what in it is the replay's own, whole, or left by an interruption."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

from rangeseg_ros.batch.frame_files import FRAME_FILES
from rangeseg_ros.batch.result_bag import read_record
from rangeseg_ros.io.files import resolved
from rangeseg_ros.io.planes import columns
from rangeseg_ros.io.recordings import BagError, Recording

BAG = 'bag'
"""Name of the bag among the results."""
PICTURES = ('labels', 'overlay')
"""Which of `FRAME_FILES` every frame has."""
TERRAIN = ('terrain', 'height')
"""Which of them every frame has where terrain is asked for."""
MARK = '.rangeseg_replay'
"""Name of a file that is there, and locked, while a replay is at work."""

LEADING = ('frame', 'stamp')
"""First columns of the table of planes."""

_ENDINGS = '|'.join(re.escape(FRAME_FILES[name].ending) for name in PICTURES + TERRAIN)
_OWN = re.compile(
    rf'\d{{6,}}_-?\d+\.\d{{9}}({_ENDINGS})|(planes|stairs|ground)\.csv|map\.(csv|ply)|'
    r'report\.html|trajectory\.txt'
)
_PARTIAL = re.compile(rf'\.\d+\.({_OWN.pattern}|{BAG})')


@dataclass(frozen=True)
class ResultFolder:
    """Where a replay leaves its results.

    Attributes
    ----------
    path : Path
        Need not exist.
    """

    path: Path

    @property
    def bag(self) -> Path:
        """The bag, which is there when all else is."""
        return self.path / BAG

    def check(self, recording: Path, overwrite: bool) -> None:
        """Raise BagError when something is there that is no replay's, and may not be replaced."""
        source = resolved(recording)
        if resolved(self.bag) in (source, *source.parents):
            raise BagError(f'{self.bag}: exists already, not overwritten: it is the recording')
        ours = read_record(self.bag) or self._interrupted()
        if overwrite or ours:
            return
        for path in [self.bag, *self._own()]:
            if path.exists():
                raise BagError(f'{path}: exists already, not overwritten')

    @contextmanager
    def begun(self) -> Iterator[None]:
        """Clear the folder, and mark it while a replay is at work.

        Raises
        ------
        BagError
            Another replay is at work there.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        mark = self.path / MARK
        with mark.open('a') as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise BagError(f'{self.path}: another replay writes there') from None
            try:
                self._clear()
                yield
            finally:
                mark.unlink()

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

    def _interrupted(self) -> bool:
        if not self.path.is_dir():
            return False
        # The table is begun before anything else.
        with suppress(OSError), (self.path / 'planes.csv').open('rb') as table:
            header = ','.join([*LEADING, *columns()]).encode()
            if table.read(len(header) + 1) == header + b'\n':
                return True
        return any(p.name == MARK or _PARTIAL.fullmatch(p.name) for p in self.path.iterdir())

    def _clear(self) -> None:
        """Remove what other or interrupted runs have left."""
        for path in self.path.iterdir():
            if _PARTIAL.fullmatch(path.name):
                shutil.rmtree(path, ignore_errors=True)
        if self.bag.exists():
            # In one step: half of a bag could not be distinguished from a foreign one.
            aside = self.path / f'.{os.getpid()}.{BAG}'
            os.replace(self.bag, aside)
            shutil.rmtree(aside)
        for path in self._own():
            path.unlink()
