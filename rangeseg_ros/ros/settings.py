"""Parameters that take effect once everything they need is compiled."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import fields
from threading import Condition, Thread

from rangeseg_ros.compilation.preparation import FIRST, needs, prepare
from rangeseg_ros.core.config import Config
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.ros.handover import LatestReady
from rangeseg_ros.ros.parameters import NodeConfig


class Settings:
    """The configuration in use: the newest one whose kernels are there.

    Those that need no other kernels count at once. While others compile, the one before serves.
    The first serves for the outputs `FIRST` before the kernels of the others are there. `report`
    gets how far a compilation is, and the empty string after the last; `changed` is called after
    another configuration has come into use, by any thread. `wanted` is the one that was asked for
    last; `busy` while something is compiled or loaded.
    """

    def __init__(
        self, config: NodeConfig, report: Callable[[str], None], changed: Callable[[], None]
    ) -> None:
        self._report = report
        self._on_change = changed
        self._in_use: NodeConfig | None = None
        self.wanted = config
        self._prepared: set[tuple[object, ...]] = set()
        self._jobs: LatestReady[NodeConfig] = LatestReady()
        self._closed = self.busy = False
        self._ready: frozenset[str] = frozenset()
        self._came = Condition()
        self._thread = Thread(target=self._work, name='compilation', daemon=True)
        self._thread.start()
        self.want(config)

    @property
    def pending(self) -> bool:
        """Whether what was asked for is not in use yet."""
        return self._in_use is not self.wanted

    def want(self, config: NodeConfig) -> None:
        """Ask for another configuration."""
        self.wanted = config
        current = self._in_use
        # What runs the kernels of the one in use need not wait for those of other outputs.
        serves = current is not None and _needs(current) == _needs(config)
        if serves or _needs(config) in self._prepared:
            self._use(config)
        else:
            self._jobs.put(config)

    def in_use(self) -> NodeConfig | None:
        """The configuration for the next frame; waits for the first. None once closed."""
        with self._came:
            self._came.wait_for(lambda: self._closed or self._in_use is not None)
            return None if self._closed else self._in_use

    def ready_for(self, output: str) -> bool:
        """Wait until the kernels of an output are there. False once closed."""
        with self._came:
            self._came.wait_for(lambda: self._closed or output in self._ready)
            return not self._closed

    def ready_first(self, outputs: Iterable[str]) -> list[str]:
        """`outputs` in their order, those before the others whose kernels are there."""
        return sorted(outputs, key=lambda name: name not in self._ready)

    def close(self) -> None:
        """Let those who wait go."""
        with self._came:
            self._closed = True
            self._came.notify_all()
        self._jobs.close()

    def _use(self, config: NodeConfig) -> None:
        with self._came:
            # Another thread may have asked for another one by now.
            if config is self.wanted or self._in_use is None:
                self._in_use = config
            self._came.notify_all()
        self._on_change()

    def _work(self) -> None:
        while job := self._jobs.take():
            config, _ = job
            self.busy = True
            if self._in_use is None:
                self._prepare(config, FIRST)
                self._use(config)
            self._prepare(config, tuple(OUTPUTS))
            self._prepared.add(_needs(config))
            self._report('')
            self.busy = False
            self._use(config)

    def _prepare(self, config: NodeConfig, outputs: tuple[str, ...]) -> None:
        # What cannot be compiled will be reported by the frame that needs it.
        try:
            core, kind = _rehearsed(config)
            prepare(core, (kind,), self._report, outputs)
        except Exception as error:
            self._report(f'not compiled ahead: {error}')
        with self._came:
            self._ready |= frozenset(outputs)
            self._came.notify_all()


def _needs(config: NodeConfig) -> tuple[object, ...]:
    """What decides which kernels run."""
    core, kind = _rehearsed(config)
    return *needs(core), kind


def _rehearsed(config: NodeConfig) -> tuple[Config, str]:
    """What kernels are compiled for: parameters and kind of the input, see `rehearse`.

    Without what only the node knows, which the compiling processes need not import.
    """
    core = Config(**{field.name: getattr(config, field.name) for field in fields(Config)})
    return core, 'points' if config.input == 'points' else 'image'
