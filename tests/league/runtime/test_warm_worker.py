"""Who has prepared a league goes on as its train worker where it can, and ends in every other case."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest

from league.commands.run import run as command
from league.config import experiment as configuration
from league.config.run_spec import RunSpec
from league.config.schema import ConfigError
from league.config.sections import PlayerSettings
from league.runtime.bootstrap import create
from league.runtime.manager import Manager
from league.runtime.preflight import PrepareError, preparation
from league.runtime.warm_worker import WarmWorker
from league.runtime.worker_process import WorkerSpec
from league.scheduling.turn_scheduler import next_turns
from league.state.jobs import RatingMatch, TrainingTurn
from league.state.league_state import LeagueState
from league.system.arena_build import Built, build
from storage.store import Store
from tests.league.conftest import ENVIRONMENT, call, start, wait_for

CONFIG = replace(configuration.default("rock-paper-scissors"), league="tiny")
GAME = (
    "--arena.name", "rock-paper-scissors", "--league", "tiny", "--training.worlds", "64",
    "--training.rollout_length", "8",
    "--training.iterations_per_turn", "4", "--rating.trained", "false", "--workers.match", "0",
)  # fmt: skip
STAGES = '[[stages]]\nname = "near"\n[stages.budget]\nsteps = 1000\n[[stages]]\nname = "far"\n'


def preparing(pid: int) -> list[int]:
    """The children of a process that have prepared a league, or are doing so."""
    found = subprocess.run(["ps", "-ww", "-o", "pid=,args=", "--ppid", str(pid)], capture_output=True, text=True).stdout
    return [int(line.split()[0]) for line in found.splitlines() if "league.runtime.preflight" in line]


def is_gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"  # its parent is gone, too
    except OSError:
        return True


def wait_until_gone(*pids: int) -> None:
    deadline = time.monotonic() + 60
    while not all(map(is_gone, pids)):
        assert time.monotonic() < deadline, pids
        time.sleep(0.05)


def learner(store: Store) -> int | None:
    return next((worker.pid for worker in store.workers("tiny", 5) if worker.kinds == "train"), None)


@pytest.mark.slow
def test_it_is_the_train_worker_a_spawned_one_replaces_it_and_both_end_with_the_manager(tmp_path):
    manager = start("run", *GAME, cwd=tmp_path)
    try:
        (prepared,) = wait_for(tmp_path, lambda store: preparing(manager.pid))
        assert wait_for(tmp_path, learner) == prepared
        wait_for(tmp_path, lambda store: store.newest_checkpoints("tiny"))
        os.kill(prepared, signal.SIGKILL)
        second = wait_for(tmp_path, lambda store: (pid := learner(store)) not in (None, prepared) and pid)
        assert preparing(manager.pid) == []
        assert is_gone(prepared)
        reached = wait_for(tmp_path, lambda store: max(c.iteration for c in store.checkpoints("tiny")))
        wait_for(tmp_path, lambda store: max(c.iteration for c in store.checkpoints("tiny")) > reached)
    finally:
        manager.kill()
        manager.wait()
    wait_until_gone(second)


def test_it_ends_when_its_manager_is_killed(tmp_path):
    manager = start("run", *GAME, cwd=tmp_path)
    try:
        (prepared,) = wait_for(tmp_path, lambda store: preparing(manager.pid))
        assert wait_for(tmp_path, learner) == prepared
    finally:
        manager.kill()
        manager.wait()
    wait_until_gone(prepared)


def test_after_the_handover_it_says_to_the_terminal_what_it_has_to_say(tmp_path, capfd):
    with preparation(RunSpec.of(str(tmp_path / "store"), CONFIG), CONFIG) as (_, warm_worker):
        assert warm_worker is not None
        warm_worker.assign(WorkerSpec(RunSpec.of(str(tmp_path / "nothing"), CONFIG), ("train",), 0, os.getpid()))
        warm_worker.join()
        assert (warm_worker.exitcode, warm_worker.is_alive()) == (2, False)
    assert "league: train worker: " in capfd.readouterr().err


def test_it_ends_where_nobody_hires_it(tmp_path):
    with preparation(RunSpec.of(str(tmp_path / "store"), CONFIG), CONFIG) as (prepared, warm_worker):
        assert prepared.arena == "rock-paper-scissors"
        assert warm_worker is not None
        assert preparing(os.getpid()) == [warm_worker.pid]
    assert not warm_worker.is_alive()
    assert preparing(os.getpid()) == []


SEVERAL = "[training]\ndevices = 2\ndevice = 'cpu'\n"


@pytest.mark.parametrize(
    ("more", "keep"), [(SEVERAL, True), (f"{STAGES}[stages.training]\ndevices = 2\n", True), ("", False)]
)
def test_nobody_stands_by_for_several_devices_even_of_one_stage_or_for_another_process(
    more, keep, tmp_path, monkeypatch
):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    config = configuration.loads(f'arena.name = "rock-paper-scissors"\n{more}')
    with preparation(RunSpec.of(str(tmp_path / "store"), config), config, keep=keep) as (prepared, warm_worker):
        assert prepared.arena == "rock-paper-scissors"
        assert warm_worker is None
        assert preparing(os.getpid()) == []


@pytest.mark.slow
def test_who_has_checked_a_curriculum_prepares_its_first_stage_and_works_for_that(tmp_path):
    config = configuration.loads(f'league = "tiny"\narena.name = "rock-paper-scissors"\n{STAGES}')
    first = configuration.stage(config, 0)
    place = str(tmp_path / "store")
    with preparation(RunSpec.of(place, config), config) as (_, checked):
        assert checked is not None
        with Store.open(place) as store:
            assert [league.name for league in store.leagues()] == ["tiny"]
        spec = RunSpec.of(place, first)
        with (
            preparation(spec, first, create=False, ahead=checked) as (prepared, warm_worker),
            Store.open(place) as store,
        ):
            assert warm_worker is not None
            assert warm_worker is checked
            assert prepared.arena == "rock-paper-scissors"
            assert {league.name for league in store.leagues()} == {"tiny", "tiny.near"}
            assert preparing(os.getpid()) == [checked.pid]
            store.queue(next_turns(first, LeagueState.of(store, first.league)).jobs, ())
            warm_worker.assign(WorkerSpec(spec, ("train",), 0, os.getpid()))
            deadline = time.monotonic() + 300
            while not store.newest_checkpoints(first.league):
                assert time.monotonic() < deadline
                assert warm_worker.is_alive()
                time.sleep(0.1)
    assert preparing(os.getpid()) == []


def test_where_it_refuses_or_dies_nobody_is_left(tmp_path, monkeypatch):
    place, refused = str(tmp_path / "store"), replace(CONFIG, players=(PlayerSettings("green"),))
    with (
        pytest.raises(ConfigError, match="the arena's teams are"),
        preparation(RunSpec.of(place, refused), refused),
    ):
        pass
    assert preparing(os.getpid()) == []
    (tmp_path / "jax.py").write_text(
        "import os, sys\nprint('no\\nroom\\n', file=sys.stderr, flush=True)\nos._exit(7)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)  # where this process imports from, that one does
    with (
        pytest.raises(PrepareError, match=r"^preparing the league failed \(exit code 7\): room$"),
        preparation(RunSpec.of(place, CONFIG), CONFIG),
    ):
        pass
    assert preparing(os.getpid()) == []
    assert not (tmp_path / "store").exists()


WAITS = """
import sys, time
from league.config import experiment as configuration
from league.config.run_spec import RunSpec
from league.runtime.preflight import preparation
config = configuration.default("rock-paper-scissors")
with preparation(RunSpec.of(sys.argv[1], config), config) as (_, warm_worker):
    print(warm_worker.pid, flush=True)
    time.sleep(600)
"""


def test_it_ends_when_who_could_hire_it_is_killed(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", WAITS, str(tmp_path / "store")], stdout=subprocess.PIPE, text=True, env=ENVIRONMENT
    ) as asking:
        assert asking.stdout is not None
        prepared = int(asking.stdout.readline())
        asking.kill()
    wait_until_gone(prepared)


def test_it_has_ended_when_nothing_is_to_be_done_or_another_process_is_to_manage(tmp_path, monkeypatch, capsys):
    asked = ["--store", str(tmp_path / "store"), "--arena.name", "rock-paper-scissors", "--league", "tiny"]
    left = []
    monkeypatch.setattr(command, "_detach", lambda task: left.extend(preparing(os.getpid())) or 0)
    assert command.run([*asked, "--detach"]) == 0
    monkeypatch.setattr(command, "trained_enough", lambda *_: True)
    monkeypatch.setattr(command, "rating_goes_on", lambda *_: False)
    assert command.run(asked) == 0
    assert "Nobody in league tiny can learn any more" in capsys.readouterr().out
    assert left + preparing(os.getpid()) == []


LEAVES = """
import atexit, os
from dataclasses import dataclass
from pathlib import Path
from tests.arenas.solo import SoloSettings

@dataclass(frozen=True)
class Own(SoloSettings):
    name: str = "own"

    def build(self, **how):
        atexit.register(Path(f"left-{os.getpid()}").touch)
        return super().build(**how)

ARENAS = (Own(),)
"""


@pytest.mark.slow
def test_workers_that_have_done_their_work_wait_for_no_exit_handler(tmp_path):
    (tmp_path / "own.py").write_text(LEAVES)
    game = (f"{tmp_path / 'own.py'}:own", *GAME[2:], "--workers.match", "1")
    done = call("run", "--arena.name", *game, "--steps", "512", "--budget.rating_time", "0s", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.glob("left-*"))
    with Store.open(tmp_path / "league-data") as store:
        assert store.newest_checkpoints("tiny")["runner"].step == 512
        assert not store.workers("tiny", 1e6)


HANGS = """
import time
from dataclasses import dataclass
from tests.arenas.solo import SoloSettings

@dataclass(frozen=True)
class Own(SoloSettings):
    name: str = "own"

    def build(self, **how):
        if how["worlds"] == 16:  # of a batch of matches
            time.sleep(1e6)
        return super().build(**how)

ARENAS = (Own(),)
"""


@pytest.mark.slow
@pytest.mark.parametrize("early", [True, False])  # before its first job, or with it
def test_a_match_worker_that_compiles_ends_with_the_league(tmp_path, early):
    (tmp_path / "own.py").write_text(HANGS)
    quick = ("--workers.match", "1", "--workers.nice", "0", "--rating.worlds", "16")  # on a busy host too
    game = (f"{tmp_path / 'own.py'}:own", *GAME[2:], *quick)
    manager = start("run", "--arena.name", *game, *(("--budget.success", "0.999") if early else ()), cwd=tmp_path)
    try:
        compiles = "compiling matches"
        wait_for(tmp_path, lambda store: [w for w in store.workers("tiny", 5) if w.status.get("doing") == compiles])
        manager.send_signal(signal.SIGINT)
        assert manager.wait(timeout=300) == 0
    finally:
        manager.kill()
    with Store.open(tmp_path / "league-data") as store:
        assert not store.workers("tiny", 1e6)  # nobody had to be killed
        assert early or RatingMatch.kind in {job.kind for job in store.jobs("tiny", ("queued",))}  # given back
        assert not store.jobs("tiny", ("leased", "failed"))


class FakeWarmWorker:
    """Stands by, notes where it is to work, and is dead as soon as it does."""

    pid = exitcode = 1

    def __init__(self):
        self.specs: list[WorkerSpec] = []

    def assign(self, spec: WorkerSpec) -> None:
        self.specs.append(spec)

    def is_alive(self) -> bool:
        return not self.specs


def test_a_manager_hires_it_once_as_the_first_of_its_train_workers(tmp_path, monkeypatch):
    spawned = []

    class Context:
        class Process:
            pid = exitcode = 1

            def __init__(self, target, args):
                spawned.append(args[0])

            def start(self):
                pass

            def is_alive(self):
                return True

    monkeypatch.setattr("league.runtime.manager.multiprocessing.get_context", lambda _: Context)
    config = replace(CONFIG, workers=replace(CONFIG.workers, train=2))
    with Store.open(tmp_path / "store", create=True) as store:
        create(store, config, build(config, 1))
        warm_worker = FakeWarmWorker()
        manager = Manager(store, RunSpec.of(str(tmp_path / "store"), config), config, cast(WarmWorker, warm_worker))
        manager._refill_slots()
        (spec,) = warm_worker.specs
        assert (spec.kinds, spec.number) == ((TrainingTurn.kind,), 0)
        assert [(p.kinds, p.number) for p in spawned] == [(("train",), 1), (("match",), 0)]
        manager._refill_slots()  # it has died
        assert len(warm_worker.specs) == 1
        assert spawned[-1] == spec


def test_the_arena_that_is_there_is_taken_where_a_new_one_would_be_the_same():
    had = Built(build(CONFIG, 64), CONFIG, 64)
    assert had.again(replace(CONFIG, league="another"), 64) is had.arena
    for config, worlds in (
        (CONFIG, 65),
        (replace(CONFIG, workers=replace(CONFIG.workers, threads=3)), 64),
        (replace(CONFIG, engine="c"), 64),
        (replace(CONFIG, arena=configuration.default("matching-pennies").arena), 64),
    ):
        assert had.again(config, worlds) is not had.arena
