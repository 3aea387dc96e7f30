"""Players, their snapshots and checkpoints; one suite for every database."""

from dataclasses import replace

import pytest

from storage.errors import LeaseLost, StorageError, Superseded, UnknownName
from storage.records import (
    ArenaKey,
    Checkpoint,
    Job,
    League,
    Lease,
    Player,
    Snapshot,
)
from storage.store import Store
from tests.storage.conftest import KEY, finish_a_job, match, snapshot


def test_players_are_added_once_and_never_change(store: Store):
    blue = Player("cup", "blue", 0, "main", "ant")
    store.add_players([blue, Player("cup", "rogue", 0, "exploiter", "ant", group="2")])
    assert [(p.name, p.team, p.role, p.group) for p in store.players("cup")] == [
        ("blue", 0, "main", "1"),
        ("rogue", 0, "exploiter", "2"),
        ("red", 1, "main", "1"),
    ]
    for changed, told in (
        (replace(blue, team=1), r"'blue' is main of team 0 in group 1 .ant., not main of team 1 in group 1 .ant."),
        (replace(blue, group="2"), "not main of team 0 in group 2"),
        (replace(blue, roster="bee"), r"not main of team 0 in group 1 .bee."),
    ):
        with pytest.raises(StorageError, match=told):
            store.add_players([Player("cup", "green", 1, "main", "ant"), changed])
    assert blue in store.players("cup")
    assert len(store.players("cup")) == 3


def test_a_paused_player_tells_why_until_it_goes_on(store: Store):
    def blue() -> tuple[int, str | None]:
        return next((p.setbacks, p.paused) for p in store.players("cup") if p.name == "blue")

    store.set_paused("cup", "blue", "asked by hand")
    assert blue() == (0, "asked by hand")
    store.add_players([Player("cup", "blue", 0, "main", "ant")])  # the same player: as it stands now
    assert blue() == (0, "asked by hand")
    for expected in ((1, None), (2, "loss is nan, time 2"), (3, "loss is nan, time 3")):
        if expected[0] == 1:
            store.set_paused("cup", "blue", None)
        setback(store, f"loss is nan, time {expected[0]}")
        assert blue() == expected
    store.set_paused("cup", "blue", None)
    assert blue() == (3, None)
    setback(store, "loss is nan, time 4")
    assert blue() == (4, "loss is nan, time 4")
    with pytest.raises(UnknownName, match=r"no player 'blu'.*blue, red"):
        store.set_paused("cup", "blu", "x")
    with pytest.raises(UnknownName, match=r"no player 'blu'"):
        setback(store, "x", player="blu")


def setback(store: Store, reason: str, player: str = "blue") -> None:
    store.queue([Job("cup", "train", f"turn {len(store.jobs('cup'))}")])
    claimed = store.claim("cup", ["train"], "tester", seconds=60)
    assert claimed
    try:
        assert store.record_setback(claimed[0], player, reason)
    except UnknownName:
        assert store.jobs("cup", "leased") == [claimed[1]]
        raise
    done = store.jobs("cup", "done")[-1]
    assert (done.id, done.error) == (claimed[1].id, reason)


def test_a_good_turn_forgets_its_players_setbacks(store: Store):
    setback(store, "loss is nan")
    setback(store, "loss is nan", player="red")
    finish_a_job(store, checkpoints=[checkpoint(store, "blue", 1)])
    assert {p.name: p.setbacks for p in store.players("cup")} == {"blue": 0, "red": 1}


def test_a_snapshot_is_added_once_in_each_league(store: Store):
    store.create_league(League("other", ""))
    scripted = snapshot(store, "pusher", player=None)
    abroad = replace(scripted, league="other")
    for _ in range(2):
        store.add_snapshots([scripted, abroad, snapshot(store, "blue@1")])
    assert [s.name for s in store.snapshots("cup", "blue")] == ["blue@0", "blue@1"]
    assert {s.name for s in store.snapshots("cup")} == {"blue@0", "red@0", "blue@1", "pusher"}
    assert [(s.digest, s.player) for s in store.snapshots("other")] == [(scripted.digest, None)]


def test_a_snapshot_returns_as_it_was_written(store: Store):
    given = snapshot(
        *(store, "blue@1", "blue"),
        **{"script": "s", "origin": "imported", "parent": "blue@0", "initial": True, "arena": ArenaKey(*"xyz")},
        **{"settings": "seed = 7", "step": 2**40, "iteration": 3, "seconds": 0.5},
    )
    store.add_snapshots([given])
    kept = store.snapshots("cup", "blue")[1]
    assert replace(kept, created=0.0) == given
    assert abs(kept.created - store.now()) < 600
    assert kept.initial is True
    assert store.snapshots("cup", "blue")[0].arena is None


def test_two_snapshots_may_hold_the_same_bytes(store: Store):
    copy = replace(snapshot(store, "blue@0"), name="rogue@0", parent="blue@0")
    store.add_snapshots([copy])
    first, second = store.snapshots("cup", "blue")
    assert (first.name, second.name, second.parent) == ("blue@0", "rogue@0", "blue@0")
    assert first.digest == second.digest
    finish_a_job(store, matches=[replace(match(1), b="rogue@0")])
    assert [(m.a, m.b) for m in store.matches("cup")] == [("blue@0", "rogue@0")]


def test_a_snapshots_name_means_one_policy(store: Store):
    other = store.blobs.put(b"other bytes")
    for wrong in (
        [replace(snapshot(store, "blue@0"), digest=other)],
        [snapshot(store, "blue@1"), replace(snapshot(store, "blue@1"), digest=other)],  # in one call
    ):
        with pytest.raises(StorageError, match=r"Snapshot 'blue@[01]' of league 'cup' holds other bytes"):
            store.add_snapshots(wrong)
        with pytest.raises(StorageError, match="holds other bytes"):
            finish_a_job(store, snapshots=wrong)
    assert [s.name for s in store.snapshots("cup")] == ["blue@0", "red@0"]


def test_snapshots_are_ordered_by_iteration_whenever_they_were_written(store: Store):
    written = (("blue@20", 20), ("red@3", 3), ("blue@3", 3), ("blue@100", 100))
    for name, iteration in written:  # in transactions of their own, so at different times
        store.add_snapshots([snapshot(store, name, name.partition("@")[0], iteration=iteration)])
    store.add_snapshots([snapshot(store, "pusher", None), snapshot(store, "idle", None)])
    names = [s.name for s in store.snapshots("cup")]
    assert names == ["idle", "pusher", "blue@0", "red@0", "blue@3", "red@3", "blue@20", "blue@100"]


def test_a_row_never_names_a_blob_that_is_not_there(store: Store):
    absent = "0" * 64
    ghost = Snapshot("cup", "ghost", absent, "ant")
    with pytest.raises(StorageError, match=f"Blob {absent} is not in"):
        store.add_snapshots([ghost])
    for results in (
        {"snapshots": [ghost]},
        {"checkpoints": [Checkpoint("cup", "blue", absent, 1, 1, 1.0)]},
        {"matches": [replace(match(1), recording=absent)]},
    ):
        with pytest.raises(StorageError, match=f"Blob {absent} is not in"):
            finish_a_job(store, **results)
    assert len(store.snapshots("cup")) == 2
    assert store.checkpoints("cup") == []
    assert store.matches("cup") == []


def checkpoint(store: Store, player: str, iteration: int, salt: str = "") -> Checkpoint:
    digest = store.blobs.put(f"{player} {iteration} {salt}".encode())
    return Checkpoint("cup", player, digest, 2**40 + iteration, iteration, 0.5 * iteration, KEY)


def test_a_player_goes_on_from_its_newest_checkpoint_by_iteration(store: Store):
    assert store.checkpoint("cup", "blue") is None
    assert store.newest_checkpoints("cup") == {}
    initial = replace(checkpoint(store, "red", 0), arena=None)
    given = [checkpoint(store, "blue", 5), initial, checkpoint(store, "blue", 2), checkpoint(store, "blue", 5, "again")]
    for one in given:
        finish_a_job(store, checkpoints=[one])
    kept = store.checkpoints("cup")
    assert [replace(c, created=0.0) for c in kept] == given
    assert store.checkpoint("cup", "blue") == kept[3]
    assert store.checkpoint("cup", "red") == kept[1]
    assert store.newest_checkpoints("cup") == {"blue": kept[3], "red": kept[1]}


def test_only_the_newest_checkpoints_are_kept_where_asked(store: Store):
    for i in range(1, 6):
        finish_a_job(store, checkpoints=[checkpoint(store, "blue", i), checkpoint(store, "red", i)])
    finish_a_job(store, checkpoints=[checkpoint(store, "blue", 6)], keep=2)
    kept = [(c.player, c.iteration) for c in store.checkpoints("cup")]
    assert sorted(kept) == [("blue", 5), ("blue", 6), *(("red", i) for i in range(1, 6))]


def test_two_lineages_of_one_player_never_both_commit(store: Store):
    def turn(key: str) -> Lease:
        store.queue([Job("cup", "train", key)])
        claimed = store.claim("cup", ["train"], "tester", seconds=60)
        assert claimed
        return claimed[0]

    def ends(name: str, i: int) -> list[Checkpoint]:
        return [checkpoint(store, "blue", i, name), checkpoint(store, "red", i, name)]

    none = {"blue": "", "red": ""}
    first, second = turn("first"), turn("second")
    store.finish(first, bases=none, checkpoints=ends("first", 1))
    with pytest.raises(
        Superseded, match=r"Player 'blue' goes on from checkpoint [0-9a-f]{12} now; .* from none"
    ) as told:
        store.finish(second, bases=none, checkpoints=ends("second", 9), matches=[match(1)])
    assert isinstance(told.value, LeaseLost)
    bases = {name: one.digest for name, one in store.newest_checkpoints("cup").items()}
    with pytest.raises(Superseded, match=r"'red' .* now; results from 000000000000"):
        store.finish(second, bases={**bases, "red": "0" * 64}, checkpoints=ends("second", 2))
    assert [c.iteration for c in store.checkpoints("cup")] == [1, 1]
    assert store.matches("cup") == []
    store.finish(second, bases=bases, checkpoints=ends("second", 2))
    assert {c.iteration for c in store.newest_checkpoints("cup").values()} == {2}
