"""Leagues, players, policies and matches; one suite for every database."""

import time

import pytest

from storage.errors import StorageError, UnknownName
from storage.records import ArenaKey, Checkpoint, Job, League, Match, PairCounts, Player, Snapshot
from storage.store import Store

KEY = ArenaKey("sumo", "c0ffee", "c")


def snapshot(store: Store, name: str, league: str = "cup", player: str | None = "blue") -> Snapshot:
    return Snapshot(store.blobs.put(name.encode()), league, name, "ant", player)


def finish_a_job(store: Store, **results: list) -> None:
    store.queue([Job("cup", "any", f"job {len(store.jobs('cup'))}")])
    claimed = store.claim("cup", ["any"], "tester", seconds=60)
    assert claimed
    store.finish(claimed[0], **results)


def distinct_match(store: Store, seed: int, purpose: str = "rating") -> Match:
    """Every number is a different one, so that two swapped columns cannot hide."""
    blue, red = store.snapshots("cup", "blue")[0], store.snapshots("cup", "red")[0]
    counts = (11, 12, 13, 14, 5, 6, 7, PairCounts(1, 2, 3, 4, 8))
    return Match("cup", KEY, blue.digest, red.digest, *counts, seed=seed, steps=2**40 + seed, purpose=purpose)


def test_making_a_league_again_keeps_its_config(store: Store):
    again = store.create_league(League("cup", KEY, "seed = 2"))
    assert again == store.league("cup")
    assert again.config == "seed = 1"
    assert abs(again.created - store.now()) < 600
    store.set_config("cup", "seed = 2")
    assert store.leagues() == [League("cup", KEY, "seed = 2", again.created)]


@pytest.mark.parametrize("key", [KEY._replace(engine="warp"), KEY._replace(config_hash="beef")])
def test_a_league_in_another_arena_names_both(store: Store, key: ArenaKey):
    with pytest.raises(StorageError, match=f"sumo/c0ffee/c, not in {'/'.join(key)}"):
        store.create_league(League("cup", key, ""))


def test_an_unknown_league_is_told_with_the_nearest(store: Store):
    store.create_league(League("soccer", KEY, ""))
    for ask in (store.league, lambda name: store.set_config(name, ""), store.ask_stop):
        with pytest.raises(UnknownName, match=r"no league 'socer'.*cup, soccer\. Did you mean 'soccer'\?"):
            ask("socer")
    with pytest.raises(UnknownName):
        store.start_run("socer", "", "host", {})


def test_runs_are_kept_in_order(store: Store):
    first = store.start_run("cup", "seed = 1", "laptop", {"jax": "0.11"})
    second = store.start_run("cup", "seed = 2", "server", {})
    assert store.runs("cup") == [first, second]
    assert first.versions == {"jax": "0.11"}
    assert first.started <= second.started


def test_players_are_added_once_and_never_change(store: Store):
    blue = Player("cup", "blue", 0, "main", "ant")
    store.add_players([blue, Player("cup", "rogue", 0, "exploiter", "ant")])
    assert [(p.name, p.team, p.role) for p in store.players("cup")] == [
        ("blue", 0, "main"),
        ("rogue", 0, "exploiter"),
        ("red", 1, "main"),
    ]
    with pytest.raises(StorageError, match=r"'blue' is main of team 0 .ant., not main of team 1 .ant."):
        store.add_players([Player("cup", "green", 1, "main", "ant"), Player("cup", "blue", 1, "main", "ant")])
    assert blue in store.players("cup")
    assert len(store.players("cup")) == 3


def test_a_snapshot_is_added_once_in_each_league(store: Store):
    store.create_league(League("other", KEY, ""))
    scripted = snapshot(store, "script:pusher", player=None)
    abroad = snapshot(store, "script:pusher", league="other", player=None)
    for _ in range(2):
        store.add_snapshots([scripted, abroad, snapshot(store, "blue@1")])
    assert [s.name for s in store.snapshots("cup", "blue")] == ["blue@0", "blue@1"]
    assert {s.name for s in store.snapshots("cup")} == {"blue@0", "red@0", "blue@1", "script:pusher"}
    assert [(s.digest, s.player) for s in store.snapshots("other")] == [(scripted.digest, None)]


def test_a_snapshots_name_means_one_policy(store: Store):
    changed = Snapshot(store.blobs.put(b"other bytes"), "cup", "blue@0", "ant", "blue")
    with pytest.raises(StorageError, match="name"):
        store.add_snapshots([changed])
    assert len(store.snapshots("cup")) == 2


def test_a_row_never_names_a_blob_that_is_not_there(store: Store):
    absent = "0" * 64
    with pytest.raises(StorageError, match=f"Blob {absent} is not in"):
        store.add_snapshots([Snapshot(absent, "cup", "ghost", "ant")])
    for results in (
        {"snapshots": [Snapshot(absent, "cup", "ghost", "ant")]},
        {"checkpoints": [Checkpoint("cup", "blue", absent, 1, 1, 1.0)]},
        {"matches": [Match("cup", KEY, absent, absent, 1, 0, 0, 0, 1, 0, 0, PairCounts(), 1, recording=absent)]},
    ):
        with pytest.raises(StorageError, match=f"Blob {absent} is not in"):
            finish_a_job(store, **results)
    assert len(store.snapshots("cup")) == 2
    assert store.checkpoints("cup") == []
    assert store.matches("cup") == []


def test_a_player_goes_on_from_its_newest_checkpoint(store: Store):
    assert store.checkpoint("cup", "blue") is None
    given = [
        Checkpoint("cup", player, store.blobs.put(f"{player} {i}".encode()), 2**40 + i, i, 0.5 * i)
        for i in (1, 2)
        for player in ("blue", "red")
    ]
    for checkpoint in given:
        finish_a_job(store, checkpoints=[checkpoint])
    kept = store.checkpoints("cup")
    assert [(c.player, c.digest, c.step, c.iteration, c.seconds) for c in kept] == [
        (c.player, c.digest, c.step, c.iteration, c.seconds) for c in given
    ]
    assert store.checkpoint("cup", "blue") == kept[2]
    assert store.checkpoint("cup", "red") == kept[3]


def test_matches_return_as_they_were_written(store: Store):
    given = [distinct_match(store, 1), distinct_match(store, 2, "gate"), distinct_match(store, 3)]
    finish_a_job(store, matches=given)
    kept = store.matches("cup")
    assert [m.id for m in kept] == [1, 2, 3]
    assert [Match(**{**vars(m), "id": 0, "created": 0.0}) for m in kept] == given
    assert [m.seed for m in store.matches("cup", purpose="gate")] == [2]
    assert [m.seed for m in store.matches("cup", purpose="rating", after=1)] == [3]


def test_workers_are_those_that_beat_lately(store: Store):
    store.beat("a:1:0", "cup", "train,match", 1, "a", {"doing": "warming up"})
    (before,) = store.workers("cup", within_seconds=60)
    store.beat("b:2:0", "cup", "match", 2, "b", {})
    time.sleep(0.01)
    store.beat("a:1:0", "cup", "train,match", 1, "a", {"doing": "turn 3", "speed": 1.5})
    first, second = store.workers("cup", within_seconds=60)
    assert (first.id, first.kinds, first.pid, first.host) == ("a:1:0", "train,match", 1, "a")
    assert first.status == {"doing": "turn 3", "speed": 1.5}
    assert first.started == before.started
    assert first.seen > before.seen
    assert store.workers("cup", within_seconds=-1) == []
    store.leave("a:1:0")
    assert store.workers("cup", within_seconds=60) == [second]


def test_a_stop_is_for_those_who_had_started(store: Store):
    store.create_league(League("other", KEY, ""))
    started = store.now()
    assert not store.stop_asked("cup", since=started)
    store.ask_stop("cup")
    assert store.stop_asked("cup", since=started)
    assert not store.stop_asked("other", since=started)
    time.sleep(0.01)
    assert not store.stop_asked("cup", since=store.now())
