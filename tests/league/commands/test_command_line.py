"""The command line tried as a clumsy user would, in processes of their own where that is what is tested."""

import os
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import pytest

from arenas.robots.files import robot_file
from arenas.robots.files.defaults import derive
from league.commands import cli
from league.commands.run.background import BackgroundRun
from league.commands.run.run import _detach
from league.config import experiment as configuration
from league.config import presets
from league.config.run_spec import RunSpec
from league.runtime.manager import ManagerError
from league.runtime.preflight import Prepared
from league.system import exit_codes
from storage.records import League
from storage.store import Store
from tests.arenas.robots.bot import mjcf
from tests.league.conftest import ENVIRONMENT, ROOT, TINY, call, command, said

OWN = """
from dataclasses import dataclass

@dataclass(frozen=True)
class Settings:
    name: str = "own"
    def build(self, **where):
        BODY

ARENAS = (Settings(),)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROBOT_LEAGUE_BLOBS", raising=False)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # lest a process started here ignores Ctrl-C
    yield tmp_path
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("run", "--detach=maybe"), '--detach = "maybe": expected true or false'),
        (("run", "--steps", "0"), "--steps = 0: must be at least 1"),
        (("run", "--workers.train", "65"), "must be between 0 and 64"),
        (("run", "--training.worlds", "1e30"), "expected a whole number"),
        (
            ("run", "--training.schedule.period_steps", "0"),
            "period_steps is 0; a phase lasts 1 environment step or more",
        ),
        (("run", "--training.schedule.until_score", "0.7"), "ends a phase of leapfrog, and kind is 'simultaneous'"),
        (("run", "--training.opponents.victim", "idle"), "does nothing with kind = 'latest'; use kind = 'fixed'"),
        (
            ("run", "--training.opponents.kind", "fixed", "--training.opponents.victim", "blue@7"),
            'victim = "blue@7": the league has no snapshot of that name; there are: ',
        ),
        (("run", "--training.schedule.until_score", "1.5"), "a score lies between 0 and 1"),
        (("run", "--arena.name", "sumo-by-team", "--training.schedule.kind", "ladder"), "ladder needs equal rosters"),
        (("run", "--store", "postgres//host/league"), "postgres//host/league"),
        (("ratings", "--fromat", "json"), "did you mean --format?"),
        (("watch", "seven"), 'match = "seven": expected a whole number'),
        (("watch", "7", "8"), "what is '8'? league watch takes MATCH"),
        (("check",), "league check needs NAME"),
        (("init", "--preset", "quikstart"), "did you mean quickstart"),
        (("statsu",), "did you mean status?"),
    ],
)
def test_bad_input_is_one_line_with_exit_code_two_and_leaves_nothing(args, says, folder, capsys):
    code, out, err = said(capsys, *args)
    assert code == 2
    assert says in err
    assert len(err.strip().splitlines()) == 1
    assert out == ""
    assert not list(folder.iterdir())


@pytest.mark.parametrize("name", [name for name in cli.COMMANDS])
def test_every_command_has_a_page_of_help(name, folder, capsys):
    code, out, _ = said(capsys, name, "--help")
    assert code == 0
    assert out.startswith(f"usage: league {name}")
    assert "--debug" in out
    assert not list(folder.iterdir())


def test_the_help_of_run_is_grouped_and_shows_the_values_that_a_file_gives(folder, capsys):
    Path("l.toml").write_text("[learner]\nlr = 0.25\n")
    _, out, _ = said(capsys, "run", "--help", "l.toml")
    for table in ("[training]", "[training.schedule]", "[learner]", "[rating]", "[arena.rules]", "[storage]"):
        assert f"\n{table} " in out
    assert "--learner.lr 0.25" in out
    assert "--for TEXT" in out
    assert "{None}" not in out


def test_a_league_that_runs_elsewhere_is_not_run_here(folder, capsys):
    with Store.open("league-data", create=True) as store:
        store.create_league(League("quickstart", configuration.dumps(presets.preset("quickstart"))))
        assert store.acquire_leadership("quickstart", "elsewhere:1:manager", 60.0)
    for args in (("run",), ("run", "--detach")):
        code, _, err = said(capsys, *args)
        assert code == exit_codes.PASSING  # the other may end, or have died a moment ago
        assert "league 'quickstart' is running already (process 1 on elsewhere)" in err


def test_a_background_run_that_cannot_lead_says_why(folder):
    config = replace(presets.preset("duel"), seed=5)
    with Store.open("league-data", create=True) as store:
        kept = configuration.dumps(presets.preset("duel"))
        store.create_league(League("duel", kept))
        store.acquire_leadership("duel", "elsewhere:1:manager", 60.0)
        prepared = Prepared("sumo-1v1", "c", 64, ("blue", "red"))
        with pytest.raises(ManagerError, match=r"could not start in the background: league 'duel' is running already"):
            _detach(BackgroundRun(RunSpec.of("league-data", config), prepared))
        assert store.league("duel").config == kept
        assert not store.runs("duel")


@pytest.mark.parametrize("wait_for", ["interpreter", "preparation"])
def test_ctrl_c_before_a_league_has_begun_ends_it_at_once_and_leaves_nothing(wait_for, folder):
    process = subprocess.Popen(
        command("run", *TINY), cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )  # fmt: skip
    while wait_for == "interpreter" and not _knows_databases(process.pid):
        time.sleep(0.01)
    while wait_for == "preparation" and not _preparing(process.pid):
        time.sleep(0.01)
    for child in _preparing(process.pid):
        os.kill(child, signal.SIGSTOP)  # it would end by itself once its parent has gone, and now only if it is killed
    children = _children(process.pid)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in err
    assert not list(folder.iterdir())
    _wait_for_the_end_of(children)


def _knows_databases(pid: int) -> bool:
    """Whether a process has come so far that it has the library of databases."""
    try:
        return "sqlalchemy" in Path(f"/proc/{pid}/maps").read_text()
    except OSError:
        return False


def _preparing(pid: int) -> list[int]:
    """The child that prepares a league, once it has come so far that its parent surely waits for it."""
    return [child for child in _children(pid) if _is_preparation(child) and _knows_databases(child)]


def _is_preparation(pid: int) -> bool:
    """Whether that is what a process is; one that has only been forked still has its parent's command line."""
    try:
        return b"league.runtime.preflight" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def _children(pid: int) -> list[int]:
    found = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True).stdout
    return [int(child) for child in found.split()]


def _runs(pid: int) -> bool:
    """Whether a process is alive and no zombie."""
    state = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True).stdout.strip()
    return bool(state) and not state.startswith("Z")


def _wait_for_the_end_of(pids: list[int]) -> None:
    """Until none of them runs: one that was killed is there for a moment after whoever killed it has gone."""
    deadline = time.monotonic() + 60
    while left := [pid for pid in pids if _runs(pid)]:
        if time.monotonic() > deadline:
            told = subprocess.run(["ps", "-o", "pid,stat,args", "-p", ",".join(map(str, left))], capture_output=True)
            for pid in left:
                os.kill(pid, signal.SIGKILL)
            pytest.fail(f"these have not ended:\n{told.stdout.decode()}")
        time.sleep(0.01)


@pytest.mark.slow
def test_a_league_in_the_background_leads_before_that_is_said_and_stops_when_asked(folder):
    started = call("run", *TINY, "--detach", cwd=folder)
    assert started.returncode == 0, started.stderr
    assert "Runs in the background as process" in started.stdout
    with Store.open(folder / "league-data") as store:
        assert store.leader("tiny") is not None
        (run,) = store.runs("tiny")
        kept = store.league("tiny").config
    assert run.config == kept
    assert configuration.loads(kept).league == "tiny"
    stopped = call("stop", cwd=folder)
    assert stopped.returncode == 0, stopped.stderr
    assert "League tiny has stopped." in stopped.stdout
    with Store.open(folder / "league-data") as store:
        assert store.leader("tiny") is None
    assert "is not running" in call("stop", cwd=folder).stdout


def test_a_setting_that_fails_is_not_what_the_next_run_goes_on_with(folder, capsys):
    kept = configuration.dumps(presets.preset("duel"))
    with Store.open("league-data", create=True) as store:
        store.create_league(League("duel", kept))
        code, _, err = said(capsys, "run", "--training.schedule.learner", "2")
        assert code == 2
        assert "--training.schedule.learner = 2: the arena's teams are 0 (blue), 1 (red)" in err
        assert store.league("duel").config == kept
        assert not store.players("duel")


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ("raise KeyError('no rotor')", "KeyError: 'no rotor' (own.py:8)"),
        ("raise SystemExit(4)", "it exits with 4 (own.py:8)"),
        ("import arenas.arena; return type('Half', (arenas.arena.Arena,), {})('own', {}, None, {})", "(own.py:8)"),
    ],
)
def test_check_fails_an_arena_that_raises_exits_or_is_abstract_with_its_line(body, says, folder, capsys):
    Path("own.py").write_text(OWN.replace("BODY", body))
    code, out, err = said(capsys, "check", "own.py:own")
    assert (code, err) == (1, "")
    assert out.startswith("FAILED")
    assert says in out


ROSTER = """
from arenas.games.sumo.settings import SumoSettings

ARENAS = (SumoSettings(name="own", blue=("ROBOT",), red=("leatherback",)),)
"""


@pytest.mark.parametrize(
    ("robot", "says"),
    [
        ("gone.toml", "blue: no file gone.toml: give an MJCF (.xml) or URDF (.urdf) file"),
        ("leatherbak", "blue: unknown robot 'leatherbak': did you mean leatherback?"),
        ("bent.toml", "bent.toml: [joints]: "),
        ("lone.toml", "there is no model gone.xml; set model in its robot file"),
    ],
)
def test_check_refuses_an_arena_whose_robot_is_missing_or_wrong_in_one_line(robot, says, folder, capsys):
    Path("bot.xml").write_text(mjcf())
    written = robot_file.written(derive(Path("bot.xml")))
    Path("bent.toml").write_text(written.replace('"hr_knee" =', '"hr_kneee" ='))
    Path("lone.toml").write_text(written.replace('"bot.xml"', '"gone.xml"'))
    Path("own.py").write_text(ROSTER.replace("ROBOT", robot))
    code, out, err = said(capsys, "check", "own.py:own")
    assert (code, out) == (2, "")
    assert err.startswith("league: arena own.py:own: ")
    assert says in err
    assert "Error" not in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("body", ["import sys\nsys.exit(0)", "1 / 0", "def f(:"])
def test_check_fails_a_file_that_cannot_be_read(body, folder, capsys):
    Path("bad.py").write_text(body)
    code, out, _ = said(capsys, "check", "bad.py:bad")
    assert code == 1
    assert "FAILED  its file can be read" in out
    assert f"(bad.py:{body.count(chr(10)) + 1})" in out


def test_an_arena_of_ones_own_that_is_broken_is_told_before_a_league_is_made(folder):
    Path("own.py").write_text(OWN.replace("BODY", "raise KeyError('no rotor')"))
    done = call("run", "--arena.name", "own.py:own", cwd=folder)
    assert done.returncode == 2
    assert "KeyError: 'no rotor' (own.py:8); `league check own.py:own` examines it" in done.stderr
    assert not (folder / "league-data").exists()


@pytest.mark.slow
def test_streams_that_are_closed_are_no_files_of_the_store(tmp_path):
    """Without them the store would be opened as one, and whatever is printed would go into it."""
    brief = ("--arena.name", "rock-paper-scissors", "--steps", "1000", "--budget.rating_time", "0s")
    text = " ".join(command("run", *TINY, *brief))
    closed = subprocess.run(["bash", "-c", f"{text} <&- >&- 2>&-"], cwd=tmp_path, env=ENVIRONMENT, timeout=300)
    assert closed.returncode == 0
    assert call("verify", cwd=tmp_path).returncode == 0
    with Store.open(tmp_path / "league-data") as store:
        assert max(checkpoint.iteration for checkpoint in store.checkpoints("tiny")) > 0
