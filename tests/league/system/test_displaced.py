"""Packages of others under our names: one line where ours cannot run, and both where `agents` is another's too."""

import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from shutil import copytree, ignore_patterns

import pytest

from league.system import provenance
from league.system.packages import agents_folder
from tests.league.conftest import ENVIRONMENT

UNSAFE = {name: value for name, value in ENVIRONMENT.items() if name != "PYTHONSAFEPATH"}  # as a stranger's shell
SDK = "class Agent:\n    pass\n"
BOTH = """
import multiprocessing, pickle
{imports}
import agents.tools  # the other's
from agents.settings import HappoConfig  # ours
import agents.learner.interface

def home(value):
    return type(value).__module__ + " " + Agent.__module__

if __name__ == "__main__":
    assert pickle.loads(pickle.dumps(HappoConfig())) == HappoConfig()
    process = multiprocessing.get_context("spawn").Pool(1)
    print(process.apply(home, (HappoConfig(),)))
    process.terminate()
"""


def python(*words: str, folder: Path, path: tuple[Path, ...] = ()) -> subprocess.CompletedProcess:
    """Run Python in a folder with these folders first on its import path."""
    found = {**UNSAFE, "PYTHONPATH": os.pathsep.join(map(str, path))} if path else UNSAFE
    return subprocess.run([sys.executable, *words], cwd=folder, capture_output=True, text=True, timeout=120, env=found)


def add_sdk(site: Path) -> None:
    """Install a distribution `other-agents` there, with a package `agents` of its own."""
    (site / "agents").mkdir(parents=True, exist_ok=True)
    (site / "agents" / "__init__.py").write_text(SDK)
    (site / "agents" / "tools.py").write_text("from agents import Agent\n")
    (site / "other_agents-1.0.dist-info").mkdir()
    (site / "other_agents-1.0.dist-info" / "METADATA").write_text("Name: other-agents\nVersion: 1.0\n")
    (site / "other_agents-1.0.dist-info" / "RECORD").write_text("agents/__init__.py,,\nagents/tools.py,,\n")


def add_ours(site: Path) -> None:
    """Install our packages there, as a wheel does."""
    for package in provenance.PACKAGES:
        copytree(
            provenance.ROOT / package, site / package, ignore=ignore_patterns("__pycache__", "trained"),
            dirs_exist_ok=True,
        )  # fmt: skip
    found = site / f"robot_league-{version('robot-league')}.dist-info"
    found.mkdir()
    (found / "METADATA").write_text(f"Name: robot-league\nVersion: {version('robot-league')}\n")
    record = [f"agents/{file.name},,{file.stat().st_size}\n" for file in (site / "agents").glob("[a-z]*.py")]
    (found / "RECORD").write_text("".join(record))


@pytest.fixture(params=["ours first", "ours last", "a checkout"])
def beside(request, tmp_path) -> tuple[Path, ...]:
    """The import path of an environment with both, in either order of installation, or with ours as a checkout."""
    site = tmp_path / "site"
    if request.param == "a checkout":
        add_sdk(site)
        return site, provenance.ROOT
    for add in (add_ours, add_sdk) if request.param == "ours first" else (add_sdk, add_ours):
        add(site)
    return (site,)


def test_a_folder_of_our_names_is_named_before_anything_is_imported_from_it(tmp_path):
    (tmp_path / "agents").mkdir()
    (tmp_path / "agents" / "__init__.py").write_text("raise SystemExit('imported')")
    done = python("-m", "league", "--version", folder=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith(f"league: Python imports agents from {tmp_path / 'agents'}")


def test_a_distribution_that_overwrote_a_package_of_ours_is_named(tmp_path):
    add_ours(tmp_path)
    (tmp_path / "storage" / "__init__.py").write_text('"""Another storage."""\n')
    done = python("-m", "league", "--version", folder=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "another distribution" in done.stderr
    assert str(tmp_path / "storage" / "__init__.py") in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "order", ["from agents import Agent\nimport league", "import league\nfrom agents import Agent"]
)
def test_a_program_imports_another_s_agents_and_ours(beside, order, tmp_path):
    (tmp_path / "both.py").write_text(BOTH.format(imports=order))
    done = python("both.py", folder=tmp_path, path=beside)
    assert (done.stdout, done.stderr) == ("agents.settings agents\n", "")


def test_commands_run_beside_another_s_agents_as_the_same_code(beside, tmp_path):
    done = python("-m", "league", "presets", "quickstart", folder=tmp_path, path=beside)
    assert (done.returncode, done.stderr) == (0, "")
    code = "from league.system import provenance; print(provenance.code()['code'])"
    if beside[-1] == provenance.ROOT:
        assert python("-c", code, folder=tmp_path, path=beside).stdout.strip() == provenance.code()["code"]


def test_the_code_s_digest_does_not_count_another_s_modules(tmp_path):
    code = "from league.system import provenance; print(provenance.code()['code'])"
    digests = []
    for name, add in (("alone", (add_ours,)), ("beside", (add_ours, add_sdk))):
        for each in add:
            each(tmp_path / name)
        digests.append(python("-c", code, folder=tmp_path, path=(tmp_path / name,)).stdout)
    assert digests[0] == digests[1] != ""


@pytest.mark.parametrize("where", ["overwritten", "beside a checkout"])
def test_a_module_of_one_name_in_both_is_named(where, tmp_path):
    site = tmp_path / "site"
    if where == "overwritten":
        add_ours(site)
    add_sdk(site)
    (site / "agents" / "errors.py").write_text("class AgentsException(Exception):\n    pass\n")
    path = (site,) if where == "overwritten" else (site, provenance.ROOT)
    for command in ("doctor", "ratings"):
        done = python("-m", "league", command, folder=tmp_path, path=path)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        assert "other-agents" in done.stderr
        assert "agents/errors.py" in done.stderr or "agents.errors" in done.stderr
        assert "python -m venv" in done.stderr


def test_a_project_s_folder_agents_fits_unless_it_has_a_module_of_our_names(tmp_path):
    (tmp_path / "agents").mkdir()
    (tmp_path / "agents" / "__init__.py").write_text(SDK)
    (tmp_path / "agents" / "own.py").touch()
    (tmp_path / "train.py").write_text("import league, agents.own, agents.settings; print(agents.settings.HappoConfig)")
    assert python("train.py", folder=tmp_path).stdout == "<class 'agents.settings.HappoConfig'>\n"
    (tmp_path / "agents" / "settings.py").touch()
    told = python("train.py", folder=tmp_path).stderr.splitlines()[-1]
    assert told.startswith(f"ImportError: agents.settings is both {tmp_path / 'agents' / 'settings.py'} and Robot Le")


def test_a_folder_without_an_init_does_not_take_the_place_of_our_modules(tmp_path):
    (tmp_path / "agents").mkdir()
    (tmp_path / "agents" / "settings.py").write_text("raise SystemExit('imported')")
    done = python("-m", "league", "presets", "quickstart", folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


def test_all_our_modules_of_agents_are_served():
    entries = {path.stem for path in agents_folder.FOLDER.iterdir() if path.stem != "__pycache__"}
    assert entries == set(agents_folder.MODULES)
