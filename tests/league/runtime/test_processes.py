"""A league's processes as a person meets them: workers that join from outside, Ctrl-C once and twice."""

import os
import signal
from pathlib import Path

import pytest

from league.commands.run.join import worker
from league.system import exit_codes
from storage.errors import StorageError
from storage.store import Store
from tests.league.conftest import call, hold, start, wait_for
from tests.league.leagues import filled

GAME = (
    "--arena.name", "rock-paper-scissors", "--league", "tiny", "--training.worlds", "64",
    "--training.rollout_length", "8",
    "--rating.worlds", "64", "--rating.pairings", "2", "--rating.trained", "false", "--workers.nice", "0",
)  # fmt: skip


def pids(store: Store, *kinds: str) -> list[int]:
    return [w.pid for w in store.workers("tiny", 5) if not kinds or w.kinds in kinds]


def are_gone(found: list[int]) -> bool:
    return not any(os.path.exists(f"/proc/{pid}") for pid in found)


def test_who_would_work_for_a_league_that_nobody_runs_is_told_so(tmp_path):
    filled(tmp_path / "store").close()
    with pytest.raises(StorageError, match=r"'cup' is not running: `league run` runs it"):
        worker(["--store", str(tmp_path / "store")])


@pytest.mark.slow  # half a minute of two cores
def test_a_worker_joins_from_outside_learns_rates_and_ends_with_the_manager(tmp_path):
    """The manager's own learner is stopped, so the joined one must do its work."""
    run = start("run", *GAME, "--workers.match", "0", "--workers.lease", "3", cwd=tmp_path)
    own = wait_for(tmp_path, lambda store: pids(store, "train"))
    hold(tmp_path, own[0])
    try:
        joined = start("worker", "--store", "league-data", cwd=tmp_path)
        wait_for(tmp_path, lambda store: pids(store, "train+match"))

        def by_it(store: Store) -> list:
            done = [job for job in store.jobs("tiny", "done") if str(job.holder).split(":")[1] == str(joined.pid)]
            return [] if len(done) < 2 else done

        assert {job.kind for job in wait_for(tmp_path, by_it)} == {"train"}
        told = call("status", cwd=tmp_path).stdout
        assert f":{joined.pid}:" in told
        assert "GB free" in told
    finally:
        os.kill(own[0], signal.SIGCONT)
    assert call("stop", cwd=tmp_path).returncode == 0
    assert run.wait(timeout=120) == 0
    assert joined.wait(timeout=120) == 0
    assert "No longer works for league tiny" in (tmp_path / "out.txt").read_text()


@pytest.mark.slow  # a quarter of a minute
def test_the_first_interrupt_drains_and_the_second_ends_all_at_once(tmp_path):
    """An iteration lasts for minutes here, for which the workers ask when they are told to stop."""
    run = start("run", *GAME, "--training.rollout_length", "50000", cwd=tmp_path)
    wait_for(tmp_path, lambda store: store.jobs("tiny", "done") and store.jobs("tiny", "leased"))
    found = wait_for(tmp_path, lambda store: pids(store, "train", "match"))
    run.send_signal(signal.SIGINT)
    wait_for(tmp_path, lambda store: any(w.status == {"doing": "stopped"} for w in store.workers("tiny", 60)))
    run.send_signal(signal.SIGINT)
    assert run.wait(timeout=30) == 130
    assert are_gone(found)


@pytest.mark.slow  # two leagues begin, a quarter of a minute
def test_a_run_whose_training_was_set_aside_says_so_and_what_is_done_again_ends_well(tmp_path):
    run = (
        "run", *GAME, "--workers.match", "0", "--workers.max_attempts", "1", "--budget.rating_time", "0s",
        "--budget.steps",
    )  # fmt: skip
    assert call(*run, "2048", cwd=tmp_path).returncode == 0
    with Store.open(tmp_path / "league-data") as store:
        digest = store.newest_checkpoints("tiny")["red"].digest
        (blob,) = (tmp_path / "league-data" / "blobs").rglob(digest[2:])
    kept = blob.read_bytes()
    blob.unlink()
    told = call(*run, "4096", cwd=tmp_path)
    assert told.returncode == 2
    line = told.stderr.splitlines()[-1]
    assert line.startswith("league: a turn of training was set aside")
    assert digest in line
    blob.write_bytes(kept)
    assert call(*run, "4096", cwd=tmp_path).returncode == 0
    with Store.open(tmp_path / "league-data") as store:
        assert store.newest_checkpoints("tiny")["red"].step >= 4096


BREAKS = """
from pathlib import Path
from arenas import python_file
Reinforce = python_file(Path({example!r})).Reinforce

class Mine(Reinforce):
    def learn(self, batch):
        raise KeyError("gone")
"""


@pytest.mark.slow  # two leagues begin, a third of a minute
@pytest.mark.parametrize(
    ("schedule", "told_of", "learners"),
    [("simultaneous", "all players were", ("blue", "red")), ("frozen", "blue was", ("blue",))],
)
def test_a_run_with_paused_players_says_so_and_learns_when_they_are_mended(tmp_path, schedule, told_of, learners):
    mine = tmp_path / "mine.py"
    mine.write_text(BREAKS.format(example=str(Path(__file__).parents[3] / "docs" / "examples" / "reinforce.py")))
    run = ("run", *GAME, "--workers.match", "0", "--budget.rating_time", "0s", "--learner.class", "mine.py:Mine")
    run += ("--budget.steps", "2048", "--training.schedule.kind", schedule)
    told = call(*run, cwd=tmp_path)
    assert told.returncode == exit_codes.BAD_INPUT, told.stderr
    line = told.stderr.splitlines()[-1]
    assert line.startswith(f"league: {told_of} paused: ")
    assert "KeyError: 'gone'" in line
    mine.write_text(mine.read_text().replace('raise KeyError("gone")', "return super().learn(batch)"))
    told = call(*run, cwd=tmp_path)
    assert told.returncode == 0, told.stderr
    with Store.open(tmp_path / "league-data") as store:
        assert [player.paused for player in store.players("tiny")] == [None, None]
        learnt = store.newest_checkpoints("tiny")
        assert min(learnt[name].step for name in learners) >= 2048
