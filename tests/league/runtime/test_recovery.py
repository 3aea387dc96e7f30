"""Killed with SIGKILL at any moment, a league loses at most the work since its last checkpoint, and ends the same."""

import os
import signal

import pytest

from league.system import exit_codes
from storage.records import RATED_PURPOSES
from storage.store import Store
from tests.league.conftest import BODILESS, PUCKS, call, held_amid_a_turn, start, wait_for

# Manager and worker wait for each other between two batches of matches, so a few large ones take half of the time.
LIMITS = (
    "--deterministic", "--budget.steps", "40000", "--budget.rating_time", "5m", "--workers.lease", "60",
    "--rating.pairings", "8", "--rating.episodes_per_pair", "8", "--rating.final-episodes-per-pair", "8",
)  # fmt: skip
TWO = ("run", *PUCKS, *LIMITS, "--training.rollout_length", "16", "--budget.steps", "20000")  # as many iterations
HUNTED = (
    "run", *BODILESS, *LIMITS,
    "--players", '[{team = "blue"}, {team = "red"}, {team = "red", name = "hunter", role = "main_exploiter"}]',
    "--roles", '[{name = "main_exploiter", timeout = 9000}]',
)  # fmt: skip
UNRATED = ("--workers.match", "0")


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


def unequal_figures(*folders):
    """Return the first iteration whose figures differ between two leagues, speeds aside, with player and figures."""
    curves = []
    for folder in folders:
        with Store.open(folder / "league-data") as store:
            points = [p for player in store.players("tiny") for p in store.curves("tiny", player.name)]
            curves.append({(p.iteration, p.player): {**p.values, "steps_per_second": 0.0} for p in points})
    one, other = curves
    for at in sorted({*one, *other}):
        if one.get(at) != other.get(at):
            pairs = zip(one.get(at, {}).items(), other.get(at, {}).items(), strict=False)
            return at, [pair for pair in pairs if pair[0] != pair[1]]
    return None


def kill_manager(run, folder, *held):
    """Kill the manager, and wait until its workers, of which some may be held, have noticed and ended."""
    run.send_signal(signal.SIGKILL)
    run.wait()
    for pid in held:
        os.kill(pid, signal.SIGCONT)
    wait_for(folder, lambda store: not [w for w in store.workers("tiny", 3) if w.kinds != "manager"])


@pytest.mark.slow  # about half a minute of two cores each
@pytest.mark.parametrize("run", [TWO, HUNTED], ids=["physics", "exploiter"])
def test_killed_workers_and_manager_cost_no_result_and_change_no_byte(tmp_path, run, request):
    """Amid turns and amid rating; also where a player begins anew every few turns, and groups take turns."""
    if run is HUNTED:  # every start would compile physics for long
        request.getfixturevalue("optimised_runs")
    undisturbed, killed = tmp_path / "undisturbed", tmp_path / "killed"
    undisturbed.mkdir()
    killed.mkdir()
    assert call(*run, *UNRATED, "--budget.rating_time", "0s", cwd=undisturbed).returncode == 0

    first = start(*run, *UNRATED, cwd=killed)
    os.kill(held_amid_a_turn(killed, 4).pid, signal.SIGKILL)
    learner = held_amid_a_turn(killed, 8)  # the manager has started another one and given it the turn, to be done again
    kill_manager(first, killed, learner.pid)
    second = start(*run, cwd=killed)  # in deterministic mode rating begins when training is over
    wait_for(killed, lambda store: store.matches("tiny"))
    kill_manager(second, killed)
    before = results(killed)
    assert call(*run, cwd=killed).returncode == 0

    assert unequal_figures(undisturbed, killed) is None  # says at what figure two leagues part
    ends, frozen, matches, jobs = results(killed)
    assert (ends, frozen) == results(undisturbed)[:2] == before[:2]
    assert len(matches) > len(before[2])
    assert matches[: len(before[2])] == before[2]  # nothing recorded was lost, changed or written twice
    assert {job.state for job in jobs} == {"done"}
    assert any(job.attempt > 1 and job.failures == 1 for job in jobs)  # the first kill did hit a lease
    assert run is TWO or sum(name.startswith("hunter@") for name, _ in frozen) > 3
    rated = [
        match for match in matches if match.purpose in RATED_PURPOSES
    ]  # an episode of training is written with its turn
    assert sum(job.kind == "match" for job in jobs) * 8 == len(rated)  # eight pairings a batch


@pytest.mark.slow
def test_a_second_run_of_a_running_league_is_refused_and_stop_reaches_the_first(tmp_path):
    run = (*HUNTED, *UNRATED, "--budget.steps", str(10**9))  # it must not end before the second one has begun
    first = start(*run, cwd=tmp_path)
    wait_for(tmp_path, lambda store: of_kind(store, "manager") and of_kind(store, "train"))
    second = call(*run, cwd=tmp_path)
    assert second.returncode == exit_codes.PASSING
    assert "is running already" in second.stderr
    assert call("stop", cwd=tmp_path).returncode == 0
    assert first.wait(timeout=300) == 0
    assert "Nothing is lost" in (tmp_path / "out.txt").read_text()
