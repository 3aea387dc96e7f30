"""Leagues, their managers and workers, matches, curves and phases; one suite for every database."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import sqlalchemy as sa

from storage.database import schema
from storage.errors import StorageError, UnknownName
from storage.records import (
    CurvePoint,
    Job,
    League,
    Lease,
    Match,
    PairCounts,
    Phase,
    Player,
)
from storage.store import Store
from tests.storage.conftest import KEY, finish_a_job, match, snapshot


def distinct_match(seed: int, purpose: str = "rating", b: str | None = "red@0") -> Match:
    """Every number is a different one, so that two swapped columns cannot hide."""
    counts = (11, 12, 13, 14, 5, 6, 7, PairCounts(1, 2, 3, 4, 8))
    more = {
        "steps": 2**40 + seed,
        "purpose": purpose,
        "voids_a": 9,
        "voids_b": 10,
        "seconds": 0.5,
        "due": 21.75,
        "causes": 3,
    }
    return Match("cup", KEY._replace(engine=f"e{seed}"), "blue@0", b, *counts, seed=seed, **more)  # type: ignore[arg-type]


def test_making_a_league_again_keeps_its_config(store: Store):
    again = store.create_league(League("cup", "seed = 2"))
    assert again == store.league("cup")
    assert again.config == "seed = 1"
    assert abs(again.created - store.now()) < 600
    store.set_config("cup", "seed = 2")
    assert store.leagues() == [League("cup", "seed = 2", again.created)]


def test_an_unknown_league_is_told_with_the_nearest(store: Store):
    store.create_league(League("soccer", ""))
    for ask in (
        store.league,
        store.ask_stop,
        store.revision,
        lambda name: store.set_config(name, ""),
        lambda name: store.start_run(name, "", "host", {}),
        lambda name: store.acquire_leadership(name, "me", 60),
        lambda name: store.release_leadership(name, "me"),
        lambda name: store.queue([Job(name, "match", "a")]),
        lambda name: store.set_paused(name, "blue", None),
        lambda name: store.add_players([Player(name, "blue", 0, "main", "ant")]),
    ):
        with pytest.raises(UnknownName, match=r"no league 'socer'.*cup, soccer\. Did you mean 'soccer'\?"):
            ask("socer")


def test_runs_are_kept_in_order(store: Store):
    first = store.start_run("cup", "seed = 1", "laptop", {"jax": "0.11"})
    second = store.start_run("cup", "seed = 2", "server", {})
    assert store.runs("cup") == [first, second]
    assert first.versions == {"jax": "0.11"}
    assert first.started <= second.started


def test_a_group_has_one_phase_at_a_time(store: Store):
    first = Phase("cup", "1", 0, ("blue",), {"blue": 0, "red": 0}, {"iterations": 50})
    other = Phase("cup", "2", 0, ("rogue", "red-2"), {"rogue": 3})
    assert store.queue([Job("cup", "train", "a")], [first, other]) == 1
    assert store.queue([], [replace(first, learners=("red",))]) == 0  # the number is taken
    kept = store.phases("cup")
    assert {group: replace(phase, created=0.0) for group, phase in kept.items()} == {"1": first, "2": other}
    for number in (2, 1, 10, 9):
        store.queue([], [replace(first, number=number, learners=("red",), since={"blue": number, "red": 0})])
    assert store.phases("cup")["1"].number == 10
    assert store.phases("cup")["1"].since == {"blue": 10, "red": 0}
    assert store.phases("cup")["2"] == kept["2"]


def test_curves_return_by_player_and_iteration(store: Store):
    def point(player: str, i: int, **values: float) -> CurvePoint:
        return CurvePoint("cup", player, i, 2**40 + i, 0.25 * i, values)

    finish_a_job(store, curves=[point("red", 1, entropy=1.5), point("blue", 2, loss=0.1), point("blue", 1, loss=0.2)])
    finish_a_job(store, curves=[point("blue", 10, loss=np.float32(0.5))])
    expected = [point("blue", 1, loss=0.2), point("blue", 2, loss=0.1), point("blue", 10, loss=0.5)]
    assert store.curves("cup") == [*expected, point("red", 1, entropy=1.5)]
    assert store.curves("cup", "blue") == expected
    again = [replace(point("blue", 2, reward=3.0), step=7), point("blue", 3, reward=4.0)]  # from an older checkpoint on
    finish_a_job(store, curves=again)
    assert store.curves("cup", "blue") == [expected[0], *again, expected[2]]


def test_matches_return_as_they_were_written(store: Store):
    given = [distinct_match(1), distinct_match(2, "gate"), distinct_match(3, b=None)]
    finish_a_job(store, matches=given)
    kept = store.matches("cup")
    assert [m.id for m in kept] == [1, 2, 3]
    assert [replace(m, id=0, created=0.0) for m in kept] == given
    assert [m.seed for m in store.matches("cup", purpose="gate")] == [2]
    assert [m.seed for m in store.matches("cup", purpose="rating", after=1)] == [3]


def test_each_league_numbers_its_own_matches(store: Store):
    store.create_league(League("other", ""))
    store.add_snapshots([replace(snapshot(store, name, None), league="other") for name in ("blue@0", "red@0")])
    for league in ("cup", "other", "cup", "other"):
        store.queue([Job(league, "match", f"{len(store.matches(league))}")])
        claimed = store.claim(league, ["match"], "tester", seconds=60)
        assert claimed
        store.finish(claimed[0], matches=[replace(match(seed), league=league) for seed in (1, 2)])
    for league in ("cup", "other"):
        assert [m.id for m in store.matches(league)] == [1, 2, 3, 4]


def test_counts_are_those_of_what_there_is(store: Store):
    assert (store.last_match("cup"), store.last_match("other"), store.job_counts("cup")) == (0, 0, {})
    finish_a_job(store, matches=[match(1), match(2)])
    store.queue([Job("cup", "any", "later")])
    assert store.last_match("cup") == len(store.matches("cup")) == 2
    assert store.job_counts("cup") == {"done": 1, "queued": 1}
    assert [job.state for job in store.jobs("cup", ("queued", "done"))] == ["done", "queued"]
    assert store.snapshot_count("cup") == (len(store.snapshots("cup")), 0) == (2, 0)


def test_the_revision_moves_when_there_may_be_something_to_plan(store: Store):
    store.create_league(League("other", ""))

    def moves(change: Callable[[], object]) -> bool:
        before = store.revision("cup")
        change()
        return store.revision("cup") > before

    def lease() -> Lease:
        claimed = store.claim("cup", ["train"], "tester", seconds=60)
        assert claimed
        return claimed[0]

    blue, phase = Player("cup", "blue", 0, "main", "ant"), Phase("cup", "1", 0, ("blue",), {"blue": 0})
    job, later, one = Job("cup", "train", "a"), Job("cup", "train", "b"), snapshot(store, "blue@1")
    held: list[Lease] = []
    for change in (
        lambda: store.add_players([replace(blue, name="rogue")]),
        lambda: store.set_paused("cup", "blue", "why"),
        lambda: store.add_snapshots([one]),
        lambda: store.queue([job]),
        lambda: store.queue([], [phase]),
        lambda: store.release(lease()),
        lambda: store.fail(lease(), "error", tries=2, wait=0.0),
        lambda: store.record_setback(lease(), "blue", "nan"),
        lambda: store.queue([later]),
        lambda: store.finish(lease(), matches=[match(1)]),
        lambda: store.queue([replace(job, key="c")]),
        lambda: store.fail(lease(), "error", tries=1),
        lambda: store.requeue(store.jobs("cup", "failed")[0].id),
        lambda: store.ask_stop("cup"),
    ):
        assert moves(change)
    held.append(lease())
    for change in (
        lambda: store.add_players([blue]),
        lambda: store.add_players([]),
        lambda: store.add_snapshots([one]),
        lambda: store.queue([job, later], [phase]),
        lambda: store.claim("cup", ["train", "match"], "tester", seconds=60),
        lambda: store.renew(held[0], 60),
        lambda: store.release(Lease(99, "nobody", 1)),
        lambda: store.requeue(99),
        lambda: store.heartbeat("a:1:0", "cup", "train", 1, "a", {}),
        lambda: store.remove_silent_workers("cup", -60),
        lambda: store.acquire_leadership("cup", "me", 60),
        lambda: store.queue([replace(job, league="other")]),
    ):
        assert not moves(change)


def test_one_manager_leads_until_it_lets_go_or_is_silent(store: Store):
    store.create_league(League("other", ""))
    assert store.leader("cup") is None
    assert store.acquire_leadership("cup", "a", 60)
    assert store.acquire_leadership("cup", "a", 3600)
    holder, until = store.leader("cup") or ("", 0.0)
    assert holder == "a"
    assert 3000 < until - store.now() <= 3600
    assert not store.acquire_leadership("cup", "b", 60)
    assert not store.release_leadership("cup", "b")
    assert store.acquire_leadership("other", "b", 60)
    assert store.release_leadership("cup", "a")
    assert store.leader("cup") is None
    assert store.acquire_leadership("cup", "b", -1)  # over at once
    assert store.leader("cup") is None
    assert store.acquire_leadership("cup", "a", 60)
    assert not store.acquire_leadership("cup", "b", 60)


def test_workers_are_those_that_beat_lately(store: Store):
    store.heartbeat("a:1:0", "cup", "train,match", 1, "a", {"doing": "warming up"})
    (before,) = store.workers("cup", within_seconds=60)
    store.heartbeat("b:2:0", "cup", "match", 2, "b", {})
    time.sleep(0.01)
    store.heartbeat("a:1:0", "cup", "train,match", 1, "a", {"doing": "turn 3", "speed": 1.5})
    first, second = store.workers("cup", within_seconds=60)
    assert (first.id, first.kinds, first.pid, first.host) == ("a:1:0", "train,match", 1, "a")
    assert first.status == {"doing": "turn 3", "speed": 1.5}
    assert first.started == before.started
    assert first.seen > before.seen
    assert store.workers("cup", within_seconds=-1) == []
    store.remove_worker("a:1:0")
    assert store.workers("cup", within_seconds=60) == [second]


@pytest.mark.parametrize(
    ("payload", "told"),
    [({"x": float("nan")}, "is no JSON: Out of range"), ({"x": {1}}, "is no JSON: .*set"), ({"x": "\udcff"}, None)],
)
def test_what_no_row_can_hold_is_one_line(store: Store, payload: dict, told: str | None):
    if told is None:
        store.queue([Job("cup", "match", "a", payload)])  # JSON spells it
        assert store.jobs("cup")[0].payload == payload
        return
    for write in (
        lambda: store.queue([Job("cup", "match", "a", payload)]),
        lambda: store.heartbeat("a:1:0", "cup", "match", 1, "a", payload),
    ):
        with pytest.raises(StorageError, match=told) as caught:
            write()
        assert "\n" not in str(caught.value)
    with pytest.raises(StorageError):
        finish_a_job(store, matches=[match(2**70)])
    assert store.matches("cup") == []


def test_silent_workers_are_forgotten(store: Store):
    store.create_league(League("other", ""))
    for worker, league in (("old", "cup"), ("new", "cup"), ("abroad", "other")):
        store.heartbeat(worker, league, "train", 1, "a", {})
    with store._db.writing() as db:
        db.execute(sa.update(schema.workers).where(schema.workers.c.id != "new").values(seen=store.now() - 1000))
    assert store.remove_silent_workers("cup", older_than_seconds=900) == 1
    assert [w.id for w in store.workers("cup", 10_000)] == ["new"]
    assert [w.id for w in store.workers("other", 10_000)] == ["abroad"]


def test_a_stop_is_for_those_who_had_started(store: Store):
    store.create_league(League("other", ""))
    started = store.now()
    assert not store.stop_asked("cup", since=started)
    store.ask_stop("cup")
    assert store.stop_asked("cup", since=started)
    assert not store.stop_asked("other", since=started)
    time.sleep(0.01)
    assert not store.stop_asked("cup", since=store.now())
