"""The processes for the next stage of a curriculum: when they begin and end, and what a failure costs."""

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
from league.config.run_spec import RunSpec
from league.runtime.preflight import preparation, prepare_ahead
from league.state.league_state import LeagueState
from storage.records import ArenaKey, Checkpoint, Player
from storage.store import Store
from tests.league.conftest import ENVIRONMENT, ROOT, wait_for
from tests.league.runtime.test_warm_worker import is_gone, preparing, wait_until_gone

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
    """The state of a league whose player has learnt so far, from 512 steps an iteration."""
    learnt = Checkpoint("cup.near", "blue", "", 512 * iteration, iteration, 0.0, ArenaKey("", "", ""))
    players = [Player("cup.near", "blue", 0, "main", "robot:1:1")]
    return LeagueState(players, checkpoints={"blue": learnt})


@pytest.fixture
def compiles(monkeypatch, tmp_path):
    """A function that makes a NextStage on a machine with cores to spare."""
    monkeypatch.setattr(next_stage, "cores", lambda: 16)
    made = []

    def make(config) -> NextStage:
        made.append(NextStage(config, str(tmp_path / "store")))
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
    look(at(0), "training")
    assert compiler.process is None
    look(at(1), "training")
    first = compiler.process
    look(at(2), "training")
    assert first is not None
    assert compiler.process is first
    assert first.poll() is None
    compiler.watch(1, "warp")(at(0), "training")
    assert compiler.process is first  # it may still help the stage that begins
    compiler.watch(1, "warp")(at(1), "training")
    second = compiler.process
    assert second not in (None, first)
    assert first.returncode == -signal.SIGKILL
    compiler.watch(2, "warp")(at(1), "training")  # the last stage
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
    compiler.watch(number, engine)(at(1), "training")
    assert compiler.process is None


def test_nothing_begins_for_a_league_without_stages(compiles):
    compiler = compiles(configuration.loads("", "test"))
    compiler.watch(0, "warp")(at(1), "training")
    assert compiler.process is None


@pytest.mark.slow
def test_a_failure_is_told_once(compiles, tmp_path, capfd):
    compiler = compiles(config(odd(tmp_path, "raise RuntimeError('no ground to run on')")))
    look = compiler.watch(0, "warp")
    look(at(1), "training")
    assert compiler.process is not None
    assert ended(compiler.process) == 1
    look(at(2), "training")
    look(at(3), "training")
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("league: stage far compiles when it begins: RuntimeError: no ground to run on")


def test_the_death_of_the_process_is_told(compiles, tmp_path, capfd):
    compiler = compiles(config(odd(tmp_path, "time.sleep(1e6)")))
    look = compiler.watch(0, "warp")
    look(at(1), "training")
    assert compiler.process is not None
    compiler.process.kill()
    ended(compiler.process)
    look(at(2), "training")
    assert capfd.readouterr().err == (
        "league: stage far compiles when it begins: the process that compiled for it ended with exit code -9\n"
    )


@pytest.mark.slow
def test_it_ends_when_its_parent_is_killed(tmp_path):
    hangs = f"open({str(tmp_path / 'hangs')!r}, 'w'); time.sleep(1e6)"
    text = f"""
        import sys, time
        from league.commands.run import next_stage
        from tests.league.commands.run.test_next_stage import at, config
        next_stage.cores = lambda: 16
        compiler = next_stage.NextStage(config({odd(tmp_path, hangs)!r}), {str(tmp_path / "store")!r})
        compiler.watch(0, "warp")(at(1), "training")
        print(compiler.process.pid, compiler.prepared.pid, flush=True)
        time.sleep(1e6)
    """
    command = [sys.executable, "-c", "\n".join(line.strip() for line in text.splitlines())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT) as parent:
        assert parent.stdout is not None
        pids = list(map(int, parent.stdout.readline().split()))
        assert not any(map(is_gone, pids))
        while not (tmp_path / "hangs").exists():  # who builds the arena ahead
            time.sleep(0.05)
        parent.kill()
    wait_until_gone(*pids)


@pytest.mark.skipif(
    not (next_stage.AUTOGROUP.exists() and next_stage.AUTOGROUP.read_text()), reason="Linux groups no sessions here"
)
def test_its_session_gives_way_to_others(compiles, tmp_path):
    compiler = compiles(config(odd(tmp_path, "time.sleep(1e6)")))
    compiler.watch(0, "warp")(at(1), "training")
    group, deadline = Path(f"/proc/{compiler.process.pid}/autogroup"), time.monotonic() + 100
    while not group.read_text().endswith("nice 19\n"):
        assert time.monotonic() < deadline
        time.sleep(0.05)


SMALL = """
league = "cup"
arena.name = "rock-paper-scissors"
training.worlds = 64
training.rollout_length = 8
rating.trained = false
workers.match = 0
[[stages]]
name = "near"
budget.steps = 100_000
[[stages]]
name = "far"
budget.steps = 1000
budget.rating_time = "0s"
"""


@pytest.mark.parametrize(
    ("count", "iteration", "activity", "starts"),
    [
        (16, 0, "training", False), (16, 1, "training", True), (2, 1, "training", False),
        (2, 500, "rating", False), (2, 500, "ending", True), (2, 1, "ending", False),
    ],
)  # fmt: skip
def test_the_next_stage_is_prepared_while_players_learn_where_cores_are_to_spare_and_else_when_a_stage_has_ended(
    count, iteration, activity, starts, compiles, monkeypatch
):
    monkeypatch.setattr(next_stage, "cores", lambda: count)
    following = compiles(configuration.loads(SMALL, "test"))
    following.watch(0, "c")(at(iteration), activity)
    assert (following.prepared is not None) == starts


@pytest.mark.slow
def test_who_has_prepared_ahead_becomes_the_worker_and_is_replaced_if_it_died(tmp_path):
    stage = replace(configuration.stage(configuration.loads(SMALL, "test"), 1), after=())
    spec = RunSpec.of(str(tmp_path / "store"), stage)
    Store.open(spec.store, create=True).close()
    for dies in (False, True):
        waiting = prepare_ahead(spec, stage)
        assert waiting is not None
        if dies:
            waiting.kill()
        with preparation(spec, stage, create=False, ahead=waiting) as (prepared, worker):
            assert prepared.arena == "rock-paper-scissors"
            assert worker is not None
            assert worker.is_alive()
            assert (worker is waiting) != dies
        assert is_gone(waiting.pid)
        assert is_gone(worker.pid)


RUNS = """
import sys
from league.commands import cli
from league.commands.run import next_stage
next_stage.cores = lambda: 16
cli.main(["run", "cup.toml", *sys.argv[1:]])
"""


@pytest.mark.slow
def test_a_kill_while_the_next_stage_is_prepared_leaves_no_process_and_loses_nothing(tmp_path):
    (tmp_path / "cup.toml").write_text(SMALL.replace("100_000", "100_000_000"))
    with (tmp_path / "out.txt").open("ab") as out:
        first = subprocess.Popen([sys.executable, "-c", RUNS], cwd=tmp_path, stdout=out, stderr=out, env=ENVIRONMENT)
    try:
        both = wait_for(tmp_path, lambda store: found if len(found := preparing(first.pid)) > 1 else [])
    finally:
        first.kill()
        first.wait()
    wait_until_gone(*both)
    with Store.open(tmp_path / "league-data") as store:
        assert {league.name for league in store.leagues()} == {"cup", "cup.near"}
        before = {(c.player, c.iteration): c.digest for c in store.checkpoints("cup.near")}
        steps = 2048 + max(c.step for c in store.checkpoints("cup.near"))
    command = [sys.executable, "-c", RUNS, "--steps", str(steps)]
    again = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=500, env=ENVIRONMENT)
    assert again.returncode == 0, again.stderr
    with Store.open(tmp_path / "league-data") as store:
        after = {(c.player, c.iteration): c.digest for c in store.checkpoints("cup.near")}
        assert all(after.get(at, digest) == digest for at, digest in before.items())  # the store drops old ones
        for stage, learnt in (("near", steps), ("far", 1024)):
            assert [c.step for c in store.newest_checkpoints(f"cup.{stage}").values()] == [learnt, learnt]
            assert not store.jobs(f"cup.{stage}", "failed")


@pytest.mark.slow
def test_the_stage_compiles_no_kernel_and_no_rollout_any_more(compiles, tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOT_LEAGUE_CACHE", str(tmp_path))
    for variable in ("JAX_COMPILATION_CACHE_DIR", "WARP_CACHE_PATH"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setattr(next_stage, "NICE", 0)  # on a busy machine the lowest priority gets hardly any time
    compiler = compiles(config())
    compiler.watch(0, "warp")(at(1), "training")
    prepared = compiler.take_prepared()
    assert prepared is not None
    prepared.end()  # it compiles nothing, and takes half the time of the process that does
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
