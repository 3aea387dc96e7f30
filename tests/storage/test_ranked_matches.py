"""Matches of three and more teams in a store: rows, sums, transfer, verification and thinning."""

from dataclasses import replace
from pathlib import Path

import pytest
import sqlalchemy as sa

from storage.database import schema
from storage.errors import StorageError
from storage.maintenance.thinning import RetentionPolicy
from storage.maintenance.verify import verify
from storage.records import ArenaKey, Job, LineupTotals, RankedMatch, RatingPace
from storage.store import Store
from tests.storage.conftest import finish_a_job, match, snapshot
from tests.storage.sound import change, episode

TAG = ArenaKey("tag", "beef", "c")
RANKINGS = {(1, 2, 2): 5, (3, 1, 2): 7, (1, 1, 1): 2}
CLUSTERS = {((3, 1, 2), (1, 2, 3), (1, 1, 1)): 4, ((1, 2, 2), (1, 2, 2), (3, 1, 2)): 1}


def ranked(seed: int, **changes) -> RankedMatch:
    made = RankedMatch("cup", TAG, ("blue@0", "red@0", "idle"), RANKINGS, 3, (1, 0, 1), seed)
    return replace(made, **changes)


@pytest.fixture
def league(store: Store) -> Store:
    store.add_snapshots([snapshot(store, "idle", None)])
    return store


def test_matches_of_two_and_of_three_teams_are_one_log(league: Store):
    finish_a_job(league, matches=[match(1), ranked(2, seconds=1.5, due=4.0, causes=2, steps=70), match(3)])
    assert league.file(Job("cup", "match", "by hand"), [ranked(4, purpose="exhibition"), match(5)])
    assert [(type(m).__name__, m.id, m.seed) for m in league.log("cup")] == [
        ("Match", 1, 1), ("RankedMatch", 2, 2), ("Match", 3, 3), ("RankedMatch", 4, 4), ("Match", 5, 5),
    ]  # fmt: skip
    assert [m.id for m in league.log("cup", "rating", after=1)] == [2, 3, 5]
    assert [m.id for m in league.matches("cup")] == [1, 3, 5]
    first, second = league.ranked_matches("cup")
    assert first == ranked(2, seconds=1.5, due=4.0, causes=2, steps=70, id=2, created=first.created)
    assert (second.id, second.episodes, second.players) == (4, 14, ("blue@0", "red@0", "idle"))
    assert [m.id for m in league.ranked_matches("cup", among=["idle", "red@0"])] == [2, 4]
    assert league.ranked_matches("cup", among=["idle"]) == []
    assert league.last_match("cup") == 5


def test_sums_are_those_of_the_rows(league: Store):
    other = ("idle", "red@0", "blue@0")
    log = [ranked(1, seconds=2.0, due=9.0), match(2), ranked(3, causes=4), ranked(4, snapshots=other, due=9.0)]
    finish_a_job(league, matches=[*log, ranked(5, purpose="exhibition")])
    totals = league.totals("cup", "rating")
    assert [key.arena for key in totals] == ["tag", "sumo"]
    assert (totals[TAG].newest, totals[TAG].a, totals[match(1).arena].lineups) == (4, [], {})
    lineup = totals[TAG].lineups["blue@0", "red@0", "idle"]
    newest = max(m.created for m in league.ranked_matches("cup") if m.id in (1, 3))
    assert lineup == LineupTotals({ranks: 2 * n for ranks, n in RANKINGS.items()}, 6, (2, 0, 2), newest)
    assert totals[TAG].lineups[other].rankings == RANKINGS
    assert lineup.seed_clusters == {}
    assert league.totals("cup", "rating", until=0) == {}
    assert sorted(league.voids("cup", ["rating"], 0)) == [(0, 6, 29), (4, 3, 14)]
    assert league.booked("cup") == (2.0, 9.0)
    assert league.booked_episodes("cup") == 17
    pace = league.pace("cup", ["rating"], 4)
    assert pace == RatingPace(league.ranked_matches("cup")[2].created, 9.0, 2.0)


def test_seeds_that_rotations_share_are_kept_and_summed(league: Store):
    other = {((3, 1, 2), (1, 2, 3), (1, 1, 1)): 2, ((1, 1, 1), (1, 1, 1)): 2}
    log = [ranked(1, seed_clusters=CLUSTERS), ranked(2), ranked(3, seed_clusters=other)]
    finish_a_job(league, matches=log)
    assert [m.seed_clusters for m in league.ranked_matches("cup")] == [CLUSTERS, {}, other]
    (lineup,) = league.totals("cup", "rating")[TAG].lineups.values()
    first, second = CLUSTERS
    assert lineup.seed_clusters == {first: 6, second: 1, ((1, 1, 1), (1, 1, 1)): 2}


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        ({"snapshots": ("blue@0", "red@0", "nobody")}, "'nobody', which league 'cup' does not have"),
        ({"rankings": {(1, 1, 2): 3}}, "1,1,2 is no ranking of 3 teams"),
        ({"rankings": {(1, 2): 3}}, "1,2 is no ranking of 3 teams"),
        ({"rankings": {(1, 2, 3): -1}}, "-1 episodes ended 1,2,3"),
        ({"voids_by_team": (2, 2, 0)}, "of 3 voids, 2, 2, 0 were one team's"),
        ({"voids_by_team": (1,)}, "3 teams, and voids of 1"),
        ({"snapshots": ("blue@0", "red@0"), "voids_by_team": (0, 0)}, "2 teams, and a ranked match has three or more"),
        ({"seed_clusters": {((3, 1, 2), (1, 2, 3)): 8}}, "8 of its seeds ended 3,1,2, and 7 episodes"),
        ({"seed_clusters": {((3, 1, 2),): 1}}, "1 of its seeds have 1 episodes each, among 3 teams"),
        ({"seed_clusters": {((3, 1, 2), (1, 1, 2)): 1}}, "1,1,2 is no ranking of 3 teams"),
        ({"seed_clusters": {((3, 1, 2), (1, 2, 3)): -1}}, "-1 of its seeds have 2 episodes each"),
        ({"recording": "ab" * 32}, "put it before the row that names it"),
        ({"league": "other"}, "a result for league 'other'"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_written(league: Store, wrong, problem):
    with pytest.raises(StorageError, match=problem):
        finish_a_job(league, matches=[match(1), ranked(2, **wrong)])
    assert league.log("cup") == []
    assert league.last_match("cup") == 0


def test_rows_move_to_another_store(league: Store, tmp_path: Path):
    digest = league.blobs.put(episode("blue@0", "red@0"))
    finish_a_job(league, matches=[ranked(1, recording=digest), match(2), ranked(3, seed_clusters=CLUSTERS)])
    tables: dict[str, list] = {}
    league.dump(["cup"], lambda name, rows: tables.update({name: list(rows)}), recordings=False)
    assert [row["recording"] for row in tables["ranked_matches"]] == [None, None]
    with Store.open(tmp_path / "other", create=True, blobs=str(tmp_path / "blobs")) as other:
        other.restore(tables.items())
        want = [replace(m, recording=None) if m.recording else m for m in league.log("cup")]
        assert other.log("cup") == want
        finish_a_job(other, matches=[ranked(4)])
        assert other.ranked_matches("cup")[-1].id == 4


def test_old_recordings_are_removed_and_the_rows_stay(league: Store):
    digests = [league.blobs.put(episode(name, "red@0")) for name in ("blue@0", "idle")]
    finish_a_job(league, matches=[ranked(1, recording=digests[0]), match(2), ranked(3, recording=digests[1])])
    policy = RetentionPolicy(age=-1.0, checkpoints={}, recordings=1)
    removed = league.thin(league.find_removable(policy))
    assert removed.recordings == 1
    assert [m.recording for m in league.ranked_matches("cup")] == [None, digests[1]]
    assert [league.blobs.has(digest) for digest in digests] == [False, True]


@pytest.mark.parametrize(
    ("statement", "problem"),
    [
        ("UPDATE ranked_matches SET episodes = 13", "it counts 13 episodes, and its rankings 14"),
        ("""UPDATE ranked_matches SET rankings = '{"1,1,2": 14}'""", "1,1,2 is no ranking of 3 teams"),
        ("""UPDATE ranked_matches SET rankings = '{"1,x": 14}'""", "invalid literal"),
        ("""UPDATE ranked_matches SET snapshots = '["blue@0", "red@0", "gone"]'""", "'gone' is none of the snapshots"),
        ("""UPDATE ranked_matches SET seed_clusters = '{"1,2,2;1,2,2": 6}'""", "6 of its seeds ended 1,2,2, and 5"),
        ("""UPDATE ranked_matches SET seed_clusters = '{"1,2,2;1": 1}'""", "1 is no ranking of 3 teams"),
        ("""UPDATE ranked_matches SET seed_clusters = '{"1,2,2": 0.5}'""", "'0.5' is no number of seeds"),
        ("UPDATE ranked_matches SET purpose = 'fun'", "purpose 'fun' is none of"),
        ("DELETE FROM ranked_matches", "it counts 1 matches, and the rows of 0 are there"),
    ],
)
def test_damage_is_found(tmp_path: Path, statement, problem):
    folder = tmp_path / "store"
    with Store.open(folder, create=True) as made:
        from tests.storage.sound import fill

        fill(made)
    change(folder, "DELETE FROM matches; UPDATE leagues SET matches = 0")
    with Store.open(folder) as made:
        digest = made.blobs.put(episode("blue@1", "red@1"))
        finish_a_job(made, matches=[ranked(1, snapshots=("blue@1", "red@1", "idle"), recording=digest)])
    sound = [each.problem for each in verify(str(folder)).findings if each.kind != "orphaned"]
    assert sound == ["it is a recording of 'blue@1' against 'red@1', not of this match; ranked_matches cup/1 names it"]
    change(folder, statement)
    found = [each.problem for each in verify(str(folder)).findings]
    assert any(problem in each for each in found), found


def test_a_damaged_row_is_told_when_it_is_read(league: Store):
    finish_a_job(league, matches=[ranked(1)])
    with league._db.writing() as db:
        db.execute(sa.update(schema.ranked_matches).values(snapshots=[1, 2, 3]))
    with pytest.raises(StorageError, match="a row of table 'ranked_matches' is damaged"):
        league.ranked_matches("cup")
