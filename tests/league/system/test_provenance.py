"""The installed code runs in every process of a league, whatever lies in the folder where it is started."""

import json
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from league.commands.analyse import tables
from league.queries.query import Open
from league.snapshots import policy_file
from league.state.liveness import exists
from league.system import provenance
from league.training.update_pool import UpdateWorker
from storage.records import Player
from storage.store import Store
from tests.league.conftest import ENVIRONMENT, ROOT
from tests.league.leagues import filled

OURS = ("league", "agents", "arenas", "storage", "matchmaking", "dashboards")
UNSAFE = {name: value for name, value in ENVIRONMENT.items() if name != "PYTHONSAFEPATH"}  # as a stranger's shell
STANDARD = ("multiprocessing", "json", "runpy", "random", "socket", "queue", "tempfile", "typing")


@pytest.fixture
def trap(tmp_path: Path) -> Path:
    """A folder with files of the names of our packages and of the standard library, each of which tells who ran it."""
    folder = tmp_path / "trap"
    folder.mkdir()
    for name in (*OURS, *STANDARD):
        text = f"open({str(tmp_path / 'ran')!r}, 'a').write({name!r} + ' ')\n"
        if name in ("league", "multiprocessing"):  # another checkout
            (folder / name).mkdir()
            (folder / name / "__init__.py").write_text(text)
        else:
            (folder / f"{name}.py").write_text(text)
    return folder


def ran(trap: Path) -> str:
    told = trap.with_name("ran")
    return told.read_text() if told.exists() else ""


def script(trap: Path, program: str, *words: str) -> subprocess.CompletedProcess:
    """Run a program in that folder as a script that is installed elsewhere, as the command `league` is."""
    file = trap.with_name("bin") / "script"
    file.parent.mkdir(exist_ok=True)
    file.write_text(program)
    return subprocess.run(
        [sys.executable, str(file), *words], cwd=trap, capture_output=True, text=True, timeout=120, env=UNSAFE
    )


def test_the_folder_would_run_if_it_came_first(trap):
    subprocess.run([sys.executable, "-m", "storage"], cwd=trap, env=UNSAFE, check=False)
    assert "storage" in ran(trap)


def test_a_module_of_ours_is_run_by_this_process_s_code(trap):
    done = subprocess.run(
        provenance.command("league", "--version"), cwd=trap, capture_output=True, text=True, env=ENVIRONMENT
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip()[0].isdigit()
    assert ran(trap) == ""


def test_words_and_name_of_a_module_are_those_of_python_m(tmp_path, monkeypatch):
    (tmp_path / "told.py").write_text("import json, sys; print(json.dumps([__name__, sys.argv, sys.path[0]]))")
    monkeypatch.syspath_prepend(tmp_path)
    done = subprocess.run(provenance.command("told", "a b", "ü"), capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == ["__main__", [str(tmp_path / "told.py"), "a b", "ü"], str(tmp_path)]


def test_a_spawned_worker_runs_the_installed_code(trap):
    program = """
import league.commands.cli, multiprocessing
if __name__ == "__main__":
    process = multiprocessing.get_context("spawn").Process(target=print, args=("spawned",))
    process.start()
    process.join()
"""
    done = script(trap, program)
    assert (done.stdout, done.stderr) == ("spawned\n", "")
    assert ran(trap) == ""


def test_an_update_worker_runs_the_installed_code(trap, monkeypatch):
    monkeypatch.chdir(trap)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if folder not in ("", str(trap))])
    worker = UpdateWorker()
    try:
        assert worker._pipe.poll(60)
        assert worker._hear() == "ready"
        assert ran(trap) == ""
    finally:
        os.kill(worker.pid, 9)


@pytest.mark.slow  # a league of four processes
@pytest.mark.parametrize("how", ["here", "in the background"])
def test_a_league_that_is_run_there_runs_the_installed_code_alone(trap, how):
    words = (
        "run", "--arena.name", "rock-paper-scissors", "--training.worlds", "16", "--workers.train", "2",
        "--steps", "4096", "--budget.rating_time", "0s", "--store", "store", *(("--detach",) if how != "here" else ()),
    )  # fmt: skip
    done = script(trap, "from league.commands.cli import main\nif __name__ == '__main__': main()", *words)
    assert done.returncode == 0, done.stderr
    deadline = time.monotonic() + 120
    while how != "here" and exists(int(re.findall(r"process (\d+)", done.stdout)[0])):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert ran(trap) == ""
    with Store.open(trap / "store") as store:
        (league,) = store.leagues()
        made = {provenance.code_of(s.settings) for s in store.snapshots(league.name) if s.player}
        assert made == {provenance.code()["code"]}


def test_a_snapshot_tells_the_code_that_made_it_in_table_json_and_card(tmp_path, capsys):
    with filled(tmp_path / "store") as store:
        name = store.leagues()[0].name
        store.add_players([Player(name, "coded", 0, "main", "ant")])
        first = next(s for s in store.snapshots(name) if s.player)
        text = "seed = 1\n" + provenance.made_by()
        others = text.replace(provenance.code()["code"], "0123456789ab")
        rows = [
            replace(first, name="coded@0", player="coded", settings=text),
            replace(first, name="coded@1", player="coded", settings=others, initial=False),
        ]
        store.add_snapshots(rows)
        told = policy_file._versions(Open(store, name), rows[1])
        assert told["code"] == "0123456789ab"
    assert tables.snapshots(["--store", str(tmp_path / "store"), "--format", "json"]) == 0
    codes = {row["name"]: row["code"] for row in json.loads(capsys.readouterr().out)}
    assert codes["coded@0"] == provenance.code()["code"]
    assert codes["coded@1"] == "0123456789ab"
    assert codes[first.name] is None
    assert tables.snapshots(["--store", str(tmp_path / "store")]) == 0
    assert "0123456789ab" in capsys.readouterr().out


def test_the_code_is_known_by_the_digest_of_its_sources_and_by_its_commit():
    found = provenance.code()
    assert len(found["code"]) == provenance.DIGITS
    assert f"code {found['code']}" in provenance.made_by()
    if (ROOT / ".git").exists():
        assert len(found["commit"]) == provenance.DIGITS
    assert provenance.code_of('seed = 1\nname = "# Made by"\n') is None
