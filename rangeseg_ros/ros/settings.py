"""Parameters that take effect once everything they need is compiled."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from threading import Condition, Thread

from rangeseg_ros.compilation.preparation import FIRST, needs, prepare
from rangeseg_ros.core.config import Config
from rangeseg_ros.messages.outputs import OUTPUTS
from rangeseg_ros.ros.latest_ready import LatestReady
from rangeseg_ros.ros.parameters import NodeConfig


class Settings:
    """The configuration in use: the newest one whose kernels are there.

    Those that need no other kernels count at once. While others compile, the one before serves.
    The first serves for the outputs `FIRST` before the kernels of the others are there.

    Parameters
    ----------
    config : NodeConfig
        To start with.
    report : callable
        Gets how far a compilation is, and the empty string after the last.
    changed : callable
        Called after another one has come into use, by any thread.

    Attributes
    ----------
    busy : bool
        Whether something is being compiled or loaded.
    """

    def __init__(
        self, config: NodeConfig, report: Callable[[str], None], changed: Callable[[], None]
    ) -> None:
        self._report = report
        self._on_change = changed
        self._in_use: NodeConfig | None = None
        self._wanted = config
        self._prepared: set[tuple[object, ...]] = set()
        self._jobs: LatestReady[NodeConfig] = LatestReady()
        self._closed = self.busy = False
        self._ready: frozenset[str] = frozenset()
        self._came = Condition()
        self._thread = Thread(target=self._work, name='compilation', daemon=True)
        self._thread.start()
        self.want(config)

    @property
    def wanted(self) -> NodeConfig:
        """What was asked for last."""
        return self._wanted

    @property
    def pending(self) -> bool:
        """Whether what was asked for is not in use yet."""
        return self._in_use is not self._wanted

    def want(self, config: NodeConfig) -> None:
        """Ask for another configuration."""
        self._wanted = config
        # What runs the kernels of the one in use need not wait for those of other outputs.
        if _needs(config) in self._prepared or self._serves(config):
            self._use(config)
        else:
            self._jobs.put(config)

    def _serves(self, config: NodeConfig) -> bool:
        current = self._in_use
        return current is not None and _needs(current) == _needs(config)

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

    def in_order(self, outputs: Iterable[str], first: Sequence[str]) -> list[str]:
        """`outputs`, those of `first` before the others as soon as their kernels are there."""
        return sorted(outputs, key=lambda name: name not in first or name not in self._ready)

    def close(self) -> None:
        """Let those who wait go."""
        with self._came:
            self._closed = True
            self._came.notify_all()
        self._jobs.close()

    def _use(self, config: NodeConfig) -> None:
        with self._came:
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
            if config is self._wanted:
                self._use(config)

    def _prepare(self, config: NodeConfig, outputs: tuple[str, ...]) -> None:
        # What cannot be compiled will be reported by the frame that needs it.
        try:
            prepare(_of_core(config), (_kind(config),), self._report, outputs)
        except Exception as error:
            self._report(f'not compiled ahead: {error}')
        with self._came:
            self._ready |= frozenset(outputs)
            self._came.notify_all()


def _needs(config: NodeConfig) -> tuple[object, ...]:
    """What decides which kernels run."""
    return *needs(_of_core(config)), _kind(config)


def _kind(config: NodeConfig) -> str:
    """Of `preparation.KINDS`."""
    return 'points' if config.input == 'points' else 'image'


def _of_core(config: NodeConfig) -> Config:
    """Without what only the node knows, which the compiling processes need not import."""
    return Config(**{field.name: getattr(config, field.name) for field in fields(Config)})
