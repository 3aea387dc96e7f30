"""Training that is too large for a machine: one line that says what would fit, and what it says does fit."""

import re
import subprocess
import sys
from dataclasses import replace

import jax
import pytest

import arenas
from agents.policy.jax_policy import stack_policies
from agents.rollout.new_worlds import make_reset
from agents.rollout.rollout import make_rollout
from league.config import experiment as configuration
from league.config.schema import ConfigError
from league.runtime.validation import validate
from league.system import memory
from league.system.compiled import Compiled
from storage.errors import StorageError
from storage.store import Store
from tests.league.conftest import ENVIRONMENT

PENNIES = (
    "--arena.name", "matching-pennies", "--training.iterations_per_turn", "1", "--workers.match", "0",
    "--training.rollout_length", "32",
)  # fmt: skip


def test_what_fits_is_what_there_is_over_what_a_world_needs_in_two_digits():
    assert memory.fitting(100_000, needed=13_100, room=3_200) == 24_000
    assert memory.fitting(4096, needed=100, room=1) == 40
    assert memory.fitting(1000, needed=100, room=99) == 500  # it did not fit, whatever was counted
    assert memory.fitting(1000, needed=0, room=99) == 500
    assert memory.fitting(16, needed=100, room=1) == 0


def test_it_is_said_in_one_line_with_the_setting_to_change():
    config = configuration.default("matching-pennies")
    told = memory.describe(config, 100_000, 13_100_000_000, 3_200_000_000)
    assert told.startswith(memory.SHORT)
    assert "set training.worlds = 24000" in told
    assert "\n" not in told
    assert "set training.worlds" not in memory.describe(config, 2, 100, 1)


@pytest.mark.parametrize(
    ("error", "short"),
    [
        (RuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 42 bytes."), True),
        (RuntimeError("CUDA out of memory. Tried to allocate 20.00 MiB."), True),
        (
            RuntimeError("[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory"),
            True,
        ),
        (RuntimeError("Failed to allocate 4096 bytes on device 'cuda:0'"), True),
        (MemoryError(), True),
        (StorageError("the database is out of memory"), False),
        (RuntimeError("the shapes do not fit"), False),
    ],
)
def test_errors_that_say_so_are_known(error, short):
    assert memory.is_short(error) == short


@pytest.mark.slow
def test_what_a_rollout_needs_grows_with_its_worlds_by_xlas_own_count():
    arena = arenas.settings("matching-pennies").build()
    rollout = Compiled(make_rollout(arena, 16), arena)
    found = []
    for worlds in (256, 512, 1024):
        start = make_reset(arena)(jax.random.split(jax.random.key(0), worlds))
        rollout.ready({agent.name: stack_policies([0]) for agent in arena.agents}, start, jax.random.key(0))
        found.append(rollout.bytes)
    assert found[2] - found[1] == pytest.approx(2 * (found[1] - found[0]), rel=0.05)
    numbers = sum(a.observation_size * 2 + a.action_size + 1 for a in arena.agents)
    assert found[2] > 4 * 1024 * 16 * numbers  # the trajectory's floats at least


def test_critics_that_see_more_need_more():
    arena = arenas.settings("sumo-1v1").build(engine="c", threads=1)
    config = configuration.default("sumo-1v1")
    needs = {
        sees: memory.learning(replace(config, learner=replace(config.learner, critic_input=sees)), arena, 256)
        for sees in ("own", "all", "privileged", "same")
    }
    assert needs["own"] < needs["all"] < needs["same"]
    assert needs["own"] < needs["privileged"]
    assert memory.learning(config, arena, 512) == 2 * needs["own"]


def test_worlds_that_are_fewer_than_a_turn_has_groups_are_refused():
    opponents = '[training.opponents]\nkind = "uniform"\npast = 0.5\ngroups = 3\n'
    few = f'arena.name = "matching-pennies"\ntraining.worlds = 3\n{opponents}'
    with pytest.raises(ConfigError, match=r"^training\.opponents\.groups = 3: .* with 3 worlds .* no 5 groups; use "):
        validate(configuration.loads(few))
    assert validate(configuration.loads(f'{few}[training.schedule]\nkind = "leapfrog"\n'))
    assert validate(configuration.loads(few.replace("= 3\n[", "= 5\n[")))


@pytest.mark.slow
def test_out_of_memory_ends_a_run_in_one_line_and_what_that_says_fits(tmp_path):
    def run(worlds: int) -> subprocess.CompletedProcess:
        describe = ["run", *PENNIES, "--training.worlds", str(worlds), "--steps", "100", "--learner.epochs", "1"]
        limited = f"ulimit -v 4000000; exec {sys.executable} -m league {' '.join(describe)}"
        return subprocess.run(
            ["bash", "-c", limited], cwd=tmp_path, capture_output=True, text=True, timeout=540, env=ENVIRONMENT
        )

    refused = run(100_000)
    assert refused.returncode == 2, refused.stdout
    assert refused.stderr.count("\n") == 1
    assert refused.stderr.startswith(
        "league: out of memory: training.worlds × training.rollout_length = 100000 × 32 needs"
    )
    with Store.open(tmp_path / "league-data") as store:
        (job,) = store.jobs("main", "failed")
        assert job.failures == 1  # what is too large once is not tried again
        assert store.checkpoint("main", "blue").iteration == 0
    fits = int(re.search(r"set training\.worlds = (\d+)", refused.stderr)[1])
    assert 2 <= fits <= 50_000
    done = run(fits)
    assert done.returncode == 0, done.stderr
    with Store.open(tmp_path / "league-data") as store:
        assert store.checkpoint("main", "blue").iteration == 1
