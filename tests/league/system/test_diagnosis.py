"""`league doctor`: what it finds on this machine, and on machines that lack something."""

import json
import sys
from importlib.metadata import PackageNotFoundError, metadata

import pytest

from league.commands.run.doctor import doctor
from league.system import devices, diagnosis
from league.system.diagnosis import examine


@pytest.fixture
def driver(tmp_path, monkeypatch):
    """Install an nvidia-smi that answers with this driver version, instead of any other."""

    def install(number: str) -> None:
        tool = tmp_path / "nvidia-smi"
        tool.write_text(f"#!/bin/sh\necho 'NVIDIA H100, 81559, {number}'\n")
        tool.chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")

    return install


def test_this_machine_can_run_leagues(capsys):
    assert doctor(["--format", "json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {each["state"] for each in found} <= {"ok", "optional", "slow"}
    assert {"packages", "processor", "GPU", "engine", "extras", "graphics", "caches", "disk"} <= {
        each["check"] for each in found
    }


@pytest.mark.parametrize(("number", "state"), [("535.104.05", "slow"), ("550.54.14", "ok"), ("580.65.06", "ok")])
def test_a_driver_without_conditional_nodes_in_graphs_is_named(driver, number, state):
    driver(number)
    gpu, version = diagnosis._gpus()
    assert (version.check, version.state) == ("GPU driver", state)
    assert number in version.found
    assert gpu.found.startswith("NVIDIA H100 (80 GiB)")
    assert gpu.state == ("ok" if devices.torch_has_cuda() else "slow")


def test_every_extra_of_the_package_is_examined():
    extras = set(metadata("robot-league").get_all("Provides-Extra") or ())
    assert diagnosis.EXTRAS.keys() == extras - {"cuda", "dev"}


def test_a_missing_extra_is_optional_and_comes_with_its_command(monkeypatch):
    installed = diagnosis.version

    def version(name: str) -> str:
        if name == "rerun-sdk":
            raise PackageNotFoundError(name)
        return installed(name)

    monkeypatch.setattr(diagnosis, "version", version)
    (view,) = (each for each in diagnosis._extras() if "view," in each.found and each.state == "optional")
    assert view.advice == "pip install 'robot-league[view]'"
    assert diagnosis._graphics().found == "not tried, because rerun is not installed"


def test_a_missing_package_makes_the_answer_no(monkeypatch, capsys):
    def version(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(diagnosis, "version", version)
    packages = next(examine())
    assert packages.state == "missing"
    assert "mujoco" in packages.advice
    monkeypatch.setattr(diagnosis, "examine", lambda: iter([packages]))
    assert doctor([]) == 1
    assert "pip install" in capsys.readouterr().out


def test_a_cache_that_cannot_be_written_is_named(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("ROBOT_LEAGUE_CACHE", str(tmp_path / "file"))
    assert diagnosis._caches().state == "slow"


def test_a_full_disk_is_named(monkeypatch):
    monkeypatch.setattr(diagnosis, "LEAST_DISK", 1e9)
    assert diagnosis._disk().state == "slow"


def test_a_machine_without_torch_is_examined_all_the_same(monkeypatch, capsys):
    installed = diagnosis.version

    def version(name: str) -> str:
        if name == "torch":
            raise PackageNotFoundError(name)
        return installed(name)

    monkeypatch.setattr(diagnosis, "version", version)
    monkeypatch.setitem(sys.modules, "torch", None)  # its import raises ModuleNotFoundError
    assert doctor(["--format", "json"]) == 1
    found = {each["check"]: each for each in json.loads(capsys.readouterr().out)}
    assert found["packages"]["advice"] == "pip install torch"
    assert {"processor", "extras", "disk"} <= set(found)
