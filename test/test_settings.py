"""The configuration in use while kernels are compiled."""

from threading import Event, Thread

import pytest

pytest.importorskip('rclpy')

from rangeseg_ros.compilation.preparation import FIRST
from rangeseg_ros.ros import settings
from rangeseg_ros.ros.parameters import NodeConfig
from rangeseg_ros.ros.settings import Settings


class Compilation:
    """Takes the place of the compiler: of more than the first outputs once it is released."""

    def __init__(self, monkeypatch):
        self.came, self.release = [], Event()
        monkeypatch.setattr(settings, 'prepare', self.prepare)

    def prepare(self, config, kinds, report, outputs):
        if outputs != FIRST:
            self.release.wait()
        self.came.append(outputs)


def test_the_first_frames_wait_for_labels_and_other_outputs_for_their_kernels(monkeypatch):
    compilation = Compilation(monkeypatch)
    came = compilation.came

    def publish():
        came.append(used.ready_for('labels'))
        came.append(used.ready_for('terrain'))

    config = NodeConfig()
    used = Settings(config, lambda progress: None, lambda: None)
    assert used.in_use() is config
    publication = Thread(target=publish)
    publication.start()
    publication.join(0.2)  # it must not end by itself
    compilation.release.set()
    publication.join()
    used.close()
    assert came[0] == FIRST and came[1] is True
    assert set(came[2]) > set(FIRST) and came[3] is True


def test_what_needs_no_other_kernels_is_in_use_at_once(monkeypatch):
    compilation = Compilation(monkeypatch)
    used = Settings(NodeConfig(), lambda progress: None, lambda: None)
    first = used.in_use()
    other, normals = NodeConfig(min_pixels=500), NodeConfig(method='normals')
    used.want(other)
    assert used.in_use() is other is not first and not used.pending
    used.want(normals)
    assert used.in_use() is other and used.pending
    compilation.release.set()
    used.close()


def test_what_is_asked_for_last_is_in_use_in_the_end(monkeypatch):
    """Also when what was asked for before it is compiled later."""
    first, normals, last = NodeConfig(), NodeConfig(method='normals'), NodeConfig(min_pixels=500)
    begun, release, changed = Event(), Event(), Event()

    def prepare(config, kinds, report, outputs):
        if config.method == 'normals':
            begun.set()
            release.wait()

    monkeypatch.setattr(settings, 'prepare', prepare)
    used = Settings(first, lambda progress: None, changed.set)
    assert used.in_use() is first and used.ready_for('terrain')
    used.want(normals)
    begun.wait()
    assert used.in_use() is first
    used.want(last)
    release.set()
    assert used.in_use() is last
    exact = NodeConfig(method='normals', exact=True)
    changed.clear()
    used.want(exact)
    changed.wait()
    assert used.in_use() is exact and not used.pending
    used.close()


def test_whoever_waits_is_let_go_at_the_end(monkeypatch):
    release = Event()
    monkeypatch.setattr(settings, 'prepare', lambda *arguments: release.wait())
    used = Settings(NodeConfig(), lambda progress: None, lambda: None)
    used.close()
    assert used.in_use() is None
    assert not used.ready_for('labels')
    release.set()


def test_what_a_robot_stops_for_comes_first_once_its_kernels_are_there(monkeypatch):
    compilation = Compilation(monkeypatch)
    used = Settings(NodeConfig(), lambda progress: None, lambda: None)
    assert used.in_use()
    names = ['labels', 'normals', 'drops']
    assert used.ready_first(names) == names
    compilation.release.set()
    assert used.ready_for('drops')
    assert used.ready_first(['drops', 'nothing', 'labels']) == ['drops', 'labels', 'nothing']
    used.close()
