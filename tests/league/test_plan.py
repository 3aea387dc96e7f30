"""The plan is read off the store alone, so these tests hand it stores' contents as values."""

from dataclasses import replace

import pytest

from league import config as configuration
from league.plan import Standing, initial, next_matches, next_turn, yardsticks
from matchmaking.opponents import Opponents
from matchmaking.schedule import Schedule
from storage.records import ArenaKey, Checkpoint, Job, Match, PairCounts, Player, Snapshot

KEY = ArenaKey("sumo-2v2", "0", "c")
PLAYERS = tuple(Player("quickstart", name, team, "main", "rover") for team, name in enumerate(("blue", "red")))


def checkpoints(iteration: int, seconds: float = 0.0) -> tuple[Checkpoint, ...]:
    return tuple(Checkpoint("quickstart", p.name, f"c{p.name}", iteration * 8192, iteration, seconds) for p in PLAYERS)


def snapshots(*iterations: int, seconds: float = 1.0) -> tuple[Snapshot, ...]:
    frozen = tuple(
        Snapshot(f"{p.name}{i}", "quickstart", f"{p.name}@{i}", "rover", p.name, None, i * 8192, i, i * seconds)
        for i in iterations
        for p in PLAYERS
    )
    return (Snapshot("pusher", "quickstart", "pusher", "rover", script="pusher"), *frozen)


def standing(**given) -> Standing:
    empty = {"players": PLAYERS, "snapshots": (), "checkpoints": (), "matches": (), "jobs": ()}
    return Standing(**{**empty, **given})


def match(a: str, b: str, games: int = 128) -> Match:
    half = games // 2
    return Match("quickstart", KEY, a, b, half, 0, half, 0, half // 2, 0, half // 2, PairCounts(0, 0, half, 0, 0), 1)


def training(**changes):
    base = configuration.quickstart()
    return replace(base, training=replace(base.training, worlds=256, **changes))


def test_the_first_turn_only_makes_the_players():
    job = next_turn(training(), standing())
    assert (job.payload["first"], job.payload["last"], job.payload["learners"]) == (0, 0, [0, 1])


def test_turns_end_where_snapshots_are_due_and_never_last_longer_than_a_crash_may_cost():
    ends = []
    at = 0
    while at < 80:
        job = next_turn(training(turn=16), standing(checkpoints=checkpoints(at)))
        assert job.payload["first"] == at
        at = job.payload["last"]
        ends.append(at)
    assert ends == [1, 2, 4, 8, 16, 32, 48, 64, 80]


def test_leapfrog_turns_end_at_the_swap_and_name_one_learner():
    config = training(turn=100, schedule=Schedule("leapfrog", period=5))
    seen = []
    at = 0
    while at < 20:
        payload = next_turn(config, standing(checkpoints=checkpoints(at))).payload
        seen.append((payload["first"], payload["last"], tuple(payload["learners"])))
        at = payload["last"]
    assert {(first // 5) % 2 == learner for first, _, (learner,) in seen} == {True}
    assert {last for _, last, _ in seen} >= {5, 10, 15, 20}


def test_one_open_turn_at_a_time_and_none_when_the_budget_is_spent():
    config = training()
    open_job = Job("quickstart", "train", "train:0-1", state="leased")
    assert next_turn(config, standing(checkpoints=checkpoints(0), jobs=(open_job,))) is None
    assert next_turn(config, standing(checkpoints=checkpoints(9, seconds=300.0))) is None
    assert next_turn(config, standing(checkpoints=checkpoints(9, seconds=299.0))) is not None


def test_a_budget_in_steps_is_met_within_one_iteration():
    config = replace(training(turn=100), budget=configuration.Budget(steps=10 * 8192 + 1))
    assert next_turn(config, standing(checkpoints=checkpoints(8))).payload["last"] == 11
    assert next_turn(config, standing(checkpoints=checkpoints(11))) is None


def test_past_opponents_are_drawn_for_each_learner_from_the_others_and_by_the_seed():
    config = training(opponents=Opponents("uniform", past=0.5, groups=3))
    state = standing(checkpoints=checkpoints(4), snapshots=snapshots(0, 1, 2, 4))
    past = next_turn(config, state).payload["past"]
    assert set(past) == {"blue", "red"}
    assert len(past["blue"]) == 3
    assert all(set(group) == {"red"} and group["red"].startswith("red") for group in past["blue"])
    assert next_turn(config, state).payload["past"] == past
    others = [next_turn(replace(config, seed=s), state).payload["past"] for s in range(2, 8)]
    assert any(other != past for other in others)


def test_a_new_snapshot_first_meets_its_own_initial_one():
    state = standing(checkpoints=checkpoints(1), snapshots=snapshots(0, 1))
    (job,) = next_matches(training(), state)
    pairs = {tuple(pair) for pair in job.payload["pairs"]}
    assert {("blue1", "blue0"), ("red1", "red0")} <= pairs
    assert all(a != b for a, b in pairs)


def test_one_batch_of_matches_at_a_time():
    open_job = Job("quickstart", "match", "match:0", state="queued")
    assert next_matches(training(), standing(snapshots=snapshots(0), jobs=(open_job,))) == []


def test_when_training_is_over_the_newest_meet_all_yardsticks_until_their_quota():
    config = training()
    state = standing(checkpoints=checkpoints(64, seconds=300.0), snapshots=snapshots(0, 1, 16, 64, seconds=4.7))
    for name in ("blue", "red"):
        newest = state.history(name)[-1]
        assert [s.digest for s in yardsticks(config, state, newest)] == [f"{name}0", f"{name}16", "pusher"]
    played: list[Match] = []
    for _ in range(40):
        jobs = next_matches(config, replace(state, matches=tuple(played)))
        if not jobs or not all(a in ("blue64", "red64") for a, _ in jobs[0].payload["pairs"]):
            break
        played += [match(a, b) for job in jobs for a, b in job.payload["pairs"]]
    met = {}
    for m in played:
        met[m.a, m.b] = met.get((m.a, m.b), 0) + m.wins + m.losses
    wanted = {(f"{p}64", o) for p in ("blue", "red") for o in (f"{p}0", f"{p}16", "pusher")}
    assert met == dict.fromkeys(wanted, config.rating.final_quota)


def test_with_unlike_rosters_only_opponents_can_meet_and_initial_is_the_other_side():
    players = tuple(replace(p, roster=f"roster {p.name}") for p in PLAYERS)
    frozen = [replace(s, roster=f"roster {s.player}") for s in snapshots(0, 1) if s.player]
    state = standing(players=players, checkpoints=checkpoints(1), snapshots=frozen)
    assert initial(state, state.history("blue")[-1]).digest == "red0"
    (job,) = next_matches(training(), state)
    for a, b in job.payload["pairs"]:
        assert {a[:-1], b[:-1]} == {"blue", "red"}


@pytest.mark.parametrize("matches", [1, 3])
def test_each_match_worker_gets_a_batch_of_its_own(matches):
    config = training()
    config = replace(config, workers=replace(config.workers, match=matches))
    state = standing(checkpoints=checkpoints(64), snapshots=snapshots(0, 1, 2, 4, 8, 16, 32, 64))
    jobs = next_matches(config, state)
    assert [job.key for job in jobs] == [f"match:{i}" for i in range(matches)]
    pairs = [tuple(sorted(pair)) for job in jobs for pair in job.payload["pairs"]]
    assert len(set(pairs)) == len(pairs) == matches * config.rating.pairings
