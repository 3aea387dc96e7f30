"""Killed with SIGKILL at any moment, a league loses at most the work since its last checkpoint, and ends the same."""

import os
import signal

import pytest

from storage.records import RATED
from storage.store import Store
from tests.league.conftest import PUCKS, call, start, wait_for

STEPS = "40000"
RUN = ("run", *PUCKS, "--deterministic", "--budget.steps", STEPS, "--budget.rate", "20s", "--workers.lease", "60")
HUNTED = (
    *RUN, "--players", '[{team = "blue"}, {team = "red"}, {team = "red", name = "hunter", role = "main_exploiter"}]',
    "--roles", '[{name = "main_exploiter", timeout = 9000}]',
)  # fmt: skip


def iteration(store):
    return max((c.iteration for c in store.checkpoints("tiny")), default=-1)


def of_kind(store, kind):
    return next((w for w in store.workers("tiny", 5) if w.kinds == kind), None)


def results(folder):
    with Store.open(folder / "league-data") as store:
        ends = {p.name: store.checkpoint("tiny", p.name) for p in store.players("tiny")}
        return (
            {name: (c.digest, c.iteration, c.step) for name, c in ends.items()},
            {(s.name, s.digest) for s in store.snapshots("tiny")},
            store.matches("tiny"),
            store.jobs("tiny"),
        )


@pytest.mark.slow  # two minutes of two cores
@pytest.mark.parametrize("command", [RUN, HUNTED], ids=["two", "exploiter"])
def test_killed_workers_and_manager_cost_no_result_and_change_no_byte(tmp_path, command):
    """Also where a player begins anew every few turns, and groups take turns."""
    undisturbed, killed = tmp_path / "undisturbed", tmp_path / "killed"
    undisturbed.mkdir()
    killed.mkdir()
    assert call(*command, cwd=undisturbed).returncode == 0

    first = start(*command, cwd=killed)
    learner = wait_for(killed, lambda store: of_kind(store, "train"))
    wait_for(killed, lambda store: iteration(store) >= 8 and store.jobs("tiny", "leased", "train"))
    os.kill(learner.pid, signal.SIGKILL)  # the manager starts another one and gives it the turn, to be done again
    wait_for(killed, lambda store: iteration(store) >= 16)
    before = results(killed)
    first.send_signal(signal.SIGKILL)  # its workers notice and end
    first.wait()
    wait_for(killed, lambda store: not [w for w in store.workers("tiny", 3) if w.kinds != "manager"])
    second = start(*command, cwd=killed)
    assert second.wait(timeout=540) == 0, (killed / "out.txt").read_text()

    ends, frozen, matches, jobs = results(killed)
    assert (ends, frozen) == results(undisturbed)[:2]
    assert matches[: len(before[2])] == before[2]  # nothing recorded was lost, changed or written twice
    assert {job.state for job in jobs} == {"done"}
    assert any(job.attempt > 1 and job.failures == 1 for job in jobs)  # the first kill did hit a lease
    assert command is RUN or sum(name.startswith("hunter@") for name, _ in frozen) > 3
    rated = [match for match in matches if match.purpose in RATED]  # an episode of training is written with its turn
    assert sum(job.kind == "match" for job in jobs) * 2 == len(rated)  # two pairings a batch


def test_a_second_run_of_a_running_league_is_refused_and_stop_reaches_the_first(tmp_path):
    first = start(*RUN, cwd=tmp_path)
    wait_for(tmp_path, lambda store: of_kind(store, "manager") and of_kind(store, "train"))
    second = call(*RUN, cwd=tmp_path)
    assert second.returncode == 2
    assert "is running already" in second.stderr
    assert call("stop", cwd=tmp_path).returncode == 0
    assert first.wait(timeout=300) == 0
    assert "Nothing is lost" in (tmp_path / "out.txt").read_text()
