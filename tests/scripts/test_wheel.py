"""The wheel, installed into a fresh environment, runs a league in a folder that holds others' files of our names."""

import sys
import sysconfig
import venv
from pathlib import Path
from zipfile import ZipFile

import pytest

from league.system.provenance import PACKAGES
from tests.league.conftest import ROOT
from tests.scripts.wheel import build_wheel, run

LEAGUE = (
    "run", "--arena.name", "rock-paper-scissors", "--training.worlds", "16", "--steps", "2048",
    "--budget.rating_time", "0s", "--store", "store",
)  # fmt: skip


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel of this checkout."""
    return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture
def strangers(tmp_path) -> Path:
    """A folder with another's files of our names, each of which ends the process that imports it."""
    for name in ("agents", "arenas", "league"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise SystemExit('a stranger')")
    (tmp_path / "storage.py").write_text("raise SystemExit('a stranger')")
    return tmp_path


@pytest.mark.slow
def test_the_wheel_has_all_files_of_our_packages_and_no_other(wheel):
    ours = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    held = {name for name in ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert held == ours


@pytest.mark.slow
def test_the_wheel_runs_a_league_in_a_folder_of_strangers(wheel, strangers, tmp_path_factory):
    """The environment has our wheel, and all other packages of this one."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False, symlinks=True)
    python, command = folder / "bin" / "python", folder / "bin" / "league"
    run(sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-deps", "--no-index", wheel, cwd=folder)
    site = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).strip()
    Path(site, "others.pth").write_text(sysconfig.get_path("purelib"))  # whose own .pth files are not read
    run(command, *LEAGUE, cwd=strangers)
    assert "blue@" in run(command, "snapshots", "--store", "store", cwd=strangers)
    assert site in run(python, "-P", "-c", "import arenas; print(arenas.__file__)", cwd=strangers)
