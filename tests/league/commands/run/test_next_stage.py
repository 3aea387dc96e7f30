"""The process that compiles for the next stage of a curriculum: when it begins and ends, and what a failure costs."""

import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from league.commands.run import next_stage
from league.commands.run.next_stage import NextStage
from league.config import experiment as configuration
from league.state.league_state import LeagueState
from storage.records import ArenaKey, Checkpoint
from tests.league.conftest import ENVIRONMENT, ROOT
from tests.league.runtime.test_warm_worker import is_gone, wait_until_gone

STAGES = """
league = "cup"
arena.name = "{arena}"
engine = "warp"
training.worlds = 8
training.rollout_length = 8
rating.trained = false
workers.match = 0
[[stages]]
name = "near"
budget.steps = 64
[[stages]]
name = "far"
budget.steps = 64
[[stages]]
name = "last"
"""
BUILDS = """
import time
from dataclasses import dataclass
from tests.arenas.race import RaceSettings

@dataclass(frozen=True)
class Odd(RaceSettings):
    name: str = "odd"

    def build(self, **how):
        {does}

ARENAS = (Odd(),)
"""


def config(arena: str = f"{ROOT / 'tests' / 'arenas' / 'race.py'}:race"):
    return configuration.loads(STAGES.format(arena=arena), "test")


def at(iteration: int) -> LeagueState:
    """The state of a league whose player has learnt so far."""
    return LeagueState(
        checkpoints={"blue": Checkpoint("cup.near", "blue", "", 0, iteration, 0.0, ArenaKey("", "", ""))}
    )


@pytest.fixture
def compiles(monkeypatch):
    """A function that makes a NextStage on a machine with cores to spare."""
    monkeypatch.setattr(next_stage, "cores", lambda: 16)
    made = []

    def make(config) -> NextStage:
        made.append(NextStage(config))
        return made[-1]

    yield make
    for each in made:
        each.end()


def odd(folder: Path, does: str) -> str:
    """The name of an arena that does this where it is to be built."""
    (folder / "odd.py").write_text(BUILDS.format(does=does))
    return f"{folder / 'odd.py'}:odd"


def ended(process: subprocess.Popen) -> int:
    deadline = time.monotonic() + 500
    while process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return process.returncode


@pytest.mark.parametrize(("count", "spare"), [(2, 0), (8, 0), (12, 2), (16, 4), (128, 8)])
def test_cores_are_spared_on_large_machines_alone(count, spare, monkeypatch):
    monkeypatch.setattr(next_stage, "cores", lambda: count)
    assert next_stage.cores_to_spare(configuration.loads("", "test")) == spare


def test_it_begins_once_when_players_have_learnt_and_ends_with_the_run(compiles, tmp_path):
    compiler = compiles(config(odd(tmp_path, "time.sleep(1e6)")))
    look = compiler.watch(0, "warp")
    look(at(0))
    assert compiler.process is None
    look(at(1))
    first = compiler.process
    look(at(2))
    assert first is not None
    assert compiler.process is first
    assert first.poll() is None
    compiler.watch(1, "warp")(at(0))
    assert compiler.process is first  # it may still help the stage that begins
    compiler.watch(1, "warp")(at(1))
    second = compiler.process
    assert second not in (None, first)
    assert first.returncode == -signal.SIGKILL
    compiler.watch(2, "warp")(at(1))  # the last stage
    assert compiler.process is None
    assert second is not None
    assert second.returncode == -signal.SIGKILL


@pytest.mark.parametrize(
    ("number", "engine", "count"), [(0, "c", 16), (0, "none", 16), (2, "warp", 16), (0, "warp", 2)]
)
def test_nothing_begins_without_kernels_without_a_stage_to_follow_and_on_small_machines(
    number, engine, count, compiles, monkeypatch
):
    monkeypatch.setattr(next_stage, "cores", lambda: count)
    compiler = compiles(config())
    compiler.watch(number, engine)(at(1))
    assert compiler.process is None


def test_nothing_begins_for_a_league_without_stages(compiles):
    compiler = compiles(configuration.loads("", "test"))
    compiler.watch(0, "warp")(at(1))
    assert compiler.process is None


def test_a_failure_is_told_once(compiles, tmp_path, capfd):
    compiler = compiles(config(odd(tmp_path, "raise RuntimeError('no ground to run on')")))
    look = compiler.watch(0, "warp")
    look(at(1))
    assert compiler.process is not None
    assert ended(compiler.process) == 1
    look(at(2))
    look(at(3))
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("league: stage far compiles when it begins: RuntimeError: no ground to run on")


def test_the_death_of_the_process_is_told(compiles, tmp_path, capfd):
    compiler = compiles(config(odd(tmp_path, "time.sleep(1e6)")))
    look = compiler.watch(0, "warp")
    look(at(1))
    assert compiler.process is not None
    compiler.process.kill()
    ended(compiler.process)
    look(at(2))
    assert capfd.readouterr().err == (
        "league: stage far compiles when it begins: the process that compiled for it ended with exit code -9\n"
    )


def test_it_ends_when_its_parent_is_killed(tmp_path):
    text = f"""
        import sys, time
        from league.commands.run import next_stage
        from tests.league.commands.run.test_next_stage import at, config
        next_stage.cores = lambda: 16
        compiler = next_stage.NextStage(config({odd(tmp_path, "time.sleep(1e6)")!r}))
        compiler.watch(0, "warp")(at(1))
        print(compiler.process.pid, flush=True)
        time.sleep(1e6)
    """
    command = [sys.executable, "-c", "\n".join(line.strip() for line in text.splitlines())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        assert not is_gone(pid)
        parent.kill()
    wait_until_gone(pid)


@pytest.mark.skipif(
    not (next_stage.AUTOGROUP.exists() and next_stage.AUTOGROUP.read_text()), reason="Linux groups no sessions here"
)
def test_its_session_gives_way_to_others(compiles, tmp_path):
    compiler = compiles(config(odd(tmp_path, "time.sleep(1e6)")))
    compiler.watch(0, "warp")(at(1))
    group, deadline = Path(f"/proc/{compiler.process.pid}/autogroup"), time.monotonic() + 100
    while not group.read_text().endswith("nice 19\n"):
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
def test_the_stage_compiles_no_kernel_and_no_rollout_any_more(compiles, tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOT_LEAGUE_CACHE", str(tmp_path))
    for variable in ("JAX_COMPILATION_CACHE_DIR", "WARP_CACHE_PATH"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    compiler = compiles(config())
    compiler.watch(0, "warp")(at(1))
    assert compiler.process is not None
    assert ended(compiler.process) == 0
    kept = programs(tmp_path)
    assert {name.partition("-")[0] for name in kept} >= {"jit_rollout", "jit_reset"}
    assert len([name for name in kept if name.endswith(".o")]) > 20  # modules of Warp
    (tmp_path / "far.toml").write_text(configuration.dumps(replace(configuration.stage(config(), 1), after=())))
    run = [sys.executable, "-m", "league", "run", str(tmp_path / "far.toml"), "--store", str(tmp_path / "store")]
    subprocess.run(run, check=True, capture_output=True, timeout=500)
    assert programs(tmp_path) == kept


def programs(cache: Path) -> set[str]:
    """The files of Warp's compiled modules, and of XLA's programs that contain the arena's physics."""
    warp = {path.name for path in (cache / "robot-league" / "warp").rglob("*.o")}
    xla = {path.name for path in (cache / "robot-league" / "jax").glob("*-cache")}
    return warp | {name for name in xla if name.startswith(("jit_rollout", "jit_reset"))}
