"""A container is refused where it would see folders or control groups of this machine."""

import subprocess

import pytest

from tests.faults.supervisors import container, kubernetes
from tests.faults.supervisors.container import Container, Impossible


class Open(Container):
    """One that shares all with this machine."""

    def run(self, *command: object) -> str:
        return subprocess.run([*map(str, command)], capture_output=True, text=True, check=True).stdout


@pytest.mark.skipif(container.unified() is None, reason="no control groups of version 2 here")
def test_a_container_that_sees_folders_of_this_machine_is_refused(tmp_path):
    with pytest.raises(Impossible, match="folders of this machine"):
        Open(tmp_path, tmp_path / "layer")


def test_what_hinders_a_container_is_told(monkeypatch):
    monkeypatch.setattr(container.os, "geteuid", lambda: 1000)
    assert "root" in container.hindrance()
    monkeypatch.setattr(container.os, "geteuid", lambda: 0)
    monkeypatch.setenv("PATH", "")
    assert "systemd-nspawn" in container.hindrance()


def test_what_a_server_holds_otherwise_is_found():
    given = {"spec": {"replicas": 3, "containers": [{"name": "a", "args": ["x"]}]}}
    kept = {"spec": {"replicas": 3, "containers": [{"name": "a", "args": ["y"], "more": 1}]}, "status": {}}
    assert list(kubernetes.differences(given, given, "")) == []
    assert list(kubernetes.differences(given, kept, "")) == [".spec.containers[0].args[0]: 'x', 'y'"]
    assert len(list(kubernetes.differences(given, {}, ""))) == 1
