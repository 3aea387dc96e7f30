"""Roles in games made by hand: who ended whom, what a robot drives at, where it stays, and means over games."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.games.sumo.match import GameState
from experiments.role_clips import Examples
from experiments.role_metrics import (
    NOBODY,
    TEAM_MATE,
    End,
    Game,
    Track,
    closing,
    ended_by,
    ends,
    mean_of_games,
    numbers,
    numbers_of_side,
    share_of_games,
    table_of_ends,
)
from experiments.role_tracks import Observer
from storage.recordings.recording import Recording, RecordingHeader
from storage.records import ArenaKey
from tests.arenas.hooks import judging

KINDS, TEAM = ["anymal", "leatherback"] * 2, np.array([0, 0, 1, 1])
ANYMAL, ROVER, THEIR_ANYMAL, THEIR_ROVER = range(4)
RADIUS, DT = 4.0, 0.02
FAR = [(0.0, 2.0, 0.0), (1.0, -2.0, 0.0), (-1.0, 2.5, 0.0), (-2.0, -2.0, 0.0)]  # metres from each other
BEHIND, ASIDE = 0.6, 0.3  # m: a rover that stands so far from an ANYmal touches its hind foot
BELLY = 0.08  # m


def end_of(out: Sequence[int] = (), touches: Any = (), xy: Any = None) -> list[End]:
    """Return the ends where `touches` has (step, agent, agent) within 50 control steps."""
    gaps = np.full((50, 4, 4), np.inf)
    for step, i, j in touches:
        gaps[step, [i, j], [j, i]] = 0.0
    places = np.zeros((50, 4, 2)) if xy is None else np.broadcast_to(xy, (50, 4, 2))
    return ends(np.isin(range(4), out), np.zeros(4, bool), gaps, places, TEAM)


def test_the_opponent_that_touched_last_ended_it():
    touches = [(10, ANYMAL, THEIR_ANYMAL), (40, ANYMAL, THEIR_ROVER), (41, ANYMAL, THEIR_ROVER), (49, ANYMAL, ROVER)]
    (end,) = end_of([ANYMAL], touches, [(3.0, 0), (0, 0), (0, 0), (2.5, 0)])
    assert end == End(ANYMAL, "out", THEIR_ROVER, 2 / 50, inside=True)
    (end,) = end_of([ANYMAL], touches, [(3.0, 0), (0, 0), (0, 0), (3.5, 0)])
    assert not end.inside


def test_without_an_opponent_it_was_the_team_mate_and_else_nobody():
    (end,) = end_of([ANYMAL], [(49, ANYMAL, ROVER)])
    assert end.by == ROVER
    assert ended_by(game(end), end) == TEAM_MATE
    (end,) = end_of([ANYMAL], [(49, ROVER, THEIR_ROVER)])
    assert end.by is None
    assert ended_by(game(end), end) == NOBODY


def test_both_teams_can_lose_at_once():
    found = end_of([ANYMAL, THEIR_ROVER], [(49, ANYMAL, THEIR_ROVER)])
    assert [(end.loser, end.by) for end in found] == [(ANYMAL, THEIR_ROVER), (THEIR_ROVER, ANYMAL)]


def track(xy: np.ndarray, gaps: dict[tuple[int, int, int], float] | None = None, radius: float = 5.0) -> Track:
    """Return a track of xy (S, 4, 2) with a second between moments; `gaps` by (agent, agent, part)."""
    found = np.full((len(xy), 4, 4, 2), np.inf)
    for at, gap in (gaps or {}).items():
        found[:, *at] = gap
    return Track(xy, np.full(len(xy), radius), found, 1.0, TEAM, KINDS)


def moving(**velocity: tuple[float, float]) -> np.ndarray:
    """Return places (4, 4, 2) of robots at the corners of a square of 2 m, which move by m per moment."""
    start = np.array([(-1.0, 1.0), (-1.0, -1.0), (1.0, 1.0), (1.0, -1.0)])
    names = ("anymal", "rover", "their_anymal", "their_rover")
    speed = np.array([velocity.get(name, (0.0, 0.0)) for name in names])
    return start + np.arange(4)[:, None, None] * speed


def test_closing_is_of_own_motion_alone():
    found = closing(moving(rover=(0.1, 0.0)), 0.5)
    assert found[0, ROVER, THEIR_ROVER] == pytest.approx(0.2)
    assert found[0, ROVER, THEIR_ANYMAL] == pytest.approx(0.2 / np.sqrt(2))
    assert found[0, ROVER, ANYMAL] == pytest.approx(0.0)
    assert not found[:, THEIR_ROVER].any()


def test_what_a_rover_drives_at():
    found = numbers(track(moving(rover=(0.0, 0.15)), {(ROVER, THEIR_ANYMAL, 1): 0.4, (ROVER, THEIR_ANYMAL, 0): 0.45}))
    assert found["at legs"][ROVER] == found["near"][ROVER] == 1.0
    assert found["towards anymal"][ROVER] == pytest.approx(2 / 3)  # 0.106 m/s at first, 0.097 at last
    assert found["towards leatherback"][ROVER] == 0.0
    assert found["driving at legs"][ROVER] == pytest.approx(2 / 3)
    assert found["at legs"][ANYMAL] == 0.0
    assert np.isnan(found["legs of near"][ANYMAL])


def test_a_body_nearer_than_the_legs_and_a_leg_out_of_reach_do_not_count():
    body = numbers(track(moving(), {(ROVER, THEIR_ANYMAL, 1): 0.4, (ROVER, THEIR_ROVER, 0): 0.3}))
    assert (body["at legs"][ROVER], body["legs of near"][ROVER], body["near"][ROVER]) == (0.0, 0.0, 1.0)
    assert numbers(track(moving(), {(ROVER, THEIR_ANYMAL, 1): 0.6}))["near"][ROVER] == 0.0
    assert numbers(track(moving(), {(ROVER, ANYMAL, 1): 0.1}))["near"][ROVER] == 0.0  # its team-mate


def test_places_and_stillness():
    found = numbers(track(moving(anymal=(-1.0, 1.0)), radius=np.sqrt(2) * 4))
    assert found["centre"][ANYMAL] == pytest.approx((1 + 2 + 3 + 4) / 16)
    assert found["outer fifth"][ANYMAL] == 0.25
    assert found["centre"][ROVER] == pytest.approx(0.25)
    assert (found["still"][ANYMAL], found["still"][ROVER]) == (0.0, 1.0)
    assert (found["still alone"][ROVER], found["still alone"][THEIR_ROVER]) == (1.0, 0.0)
    assert found["mate"][THEIR_ROVER] == pytest.approx(2.0)


def game(*found: End, side: int = 0, start: int = 0, **of_agents: Sequence[float]) -> Game:
    return Game({name: np.array(values) for name, values in of_agents.items()}, found, TEAM, KINDS, side, start)


def test_games_count_once_and_those_of_one_start_are_a_cluster():
    alone = mean_of_games(np.array([0.0, 1.0, 0.0, 1.0]), np.array([0, 1, 2, 3]))
    assert (alone["mean"], alone["n"]) == (0.5, 4)
    assert alone["high"] == pytest.approx(0.5 + 1.96 * np.sqrt(4 / 3 * 4 * 0.25) / 4, abs=1e-3)
    opposite = mean_of_games(np.array([0.0, 1.0, 0.0, 1.0]), np.array([0, 0, 1, 1]))
    assert opposite["low"] == opposite["high"] == 0.5  # each start has both
    unknown = mean_of_games(np.array([np.nan, 2.0]), np.array([0, 1]))
    assert (unknown["mean"], unknown["low"], unknown["n"]) == (2.0, None, 1)
    assert mean_of_games(np.array([np.nan]), np.array([0]))["mean"] is None


def test_shares_of_games_have_narrower_intervals_where_swapped_games_differ():
    happened = np.array([True, False] * 20)
    apart = share_of_games(happened, np.arange(40))
    opposite = share_of_games(happened, np.arange(40) // 2)
    assert apart["share"] == opposite["share"] == 0.5
    assert opposite["low"] > apart["low"] > 0.34
    assert share_of_games(np.zeros(40, bool), np.arange(40))["high"] > 0.05


def test_ends_are_told_apart_by_policy_and_kind():
    by_rover = End(ANYMAL, "out", THEIR_ROVER, 0.5, inside=True)
    games = [game(by_rover, start=0), game(by_rover, side=1, start=0), game(by_rover, start=1), game(start=1, side=1)]
    for of_a, share in ((True, 0.5), (False, 0.25)):
        cell = table_of_ends(games, of_a)["anymal out"]["leatherback"]
        assert (cell["games"], cell["share"], cell["inside"]) == (4 * share, share, 4 * share)
        assert table_of_ends(games, of_a)["anymal out"]["anymal"]["games"] == 0


def test_numbers_are_of_the_robots_of_one_policy_on_either_side():
    games = [game(side=0, start=0, centre=[0.1, 0.2, 0.3, 0.4]), game(side=1, start=1, centre=[0.5, 0.6, 0.7, 0.8])]
    assert numbers_of_side(games, of_a=True)["anymal"]["centre"]["mean"] == pytest.approx((0.1 + 0.7) / 2)
    assert numbers_of_side(games, of_a=False)["leatherback"]["centre"]["mean"] == pytest.approx((0.4 + 0.6) / 2)


# Recorded games ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def arena():
    return arenas.load("sumo-within-team", engine="c", worlds=1)


@pytest.fixture
def record(arena, stand):
    """Record robots that stand at `places` (T, 4, 3): x, y, heading; the arena judges the last moment."""

    def record(places: np.ndarray, low: Sequence[int] = (), sides: tuple[str, str] = ("a", "b")) -> Recording:
        heights = [dict.fromkeys(low, BELLY) if step == len(places) - 1 else {} for step in range(len(places))]
        physics = [stand(arena, list(map(tuple, row)), height=h) for row, h in zip(places, heights, strict=True)]
        verdict = judging(arena)(physics[-1], physics[-1], GameState(jnp.asarray(RADIUS)))[1]
        last, steps = len(places) - 1, len(places)
        teams = tuple(team.name for team in arena.teams)
        events = [(last, f"{n}: {teams[t]}") for n, who in verdict.events.items() for t in np.flatnonzero(who)]
        header = RecordingHeader(
            "hand", 0, 1, 0, ArenaKey(arena.name, arena.config_hash, "c"), sides, ("", ""), teams,
            tuple(tuple(a.name for a in team.agents) for team in arena.teams), tuple(verdict.score.tolist()), "", DT,
            arena.marker_kinds,
        )  # fmt: skip
        zero = np.zeros((steps, 2))
        ring = np.tile([0.0, 0.0, RADIUS], (steps, 1))
        actions = {a.name: np.zeros((steps, a.action_size)) for a in arena.agents}
        qpos = np.stack([np.asarray(p.qpos) for p in physics])
        return Recording(
            header, arena.scene.xml, DT * np.arange(1, steps + 1), qpos, actions, zero, zero, {"ring": ring}, events
        )

    return record


def outwards(who: int, pushed_by: int | None, behind: float, aside: float, steps: int = 121) -> np.ndarray:
    """Return places (steps, 4, 3) where a robot leaves the ring along x, another one behind it all the time."""
    places = np.tile(np.array(FAR), (steps, 1, 1))
    x = np.linspace(1.5, RADIUS + 0.05, steps)
    places[:, who] = np.stack([x, 0 * x, 0 * x], axis=1)
    if pushed_by is not None:
        places[:, pushed_by] = np.stack([x - behind, 0 * x + aside, 0 * x], axis=1)
    return places


def test_a_rover_that_pushes_an_anymal_out_by_its_foot(arena, record):
    found = Observer(arena).game(record(outwards(ANYMAL, THEIR_ROVER, BEHIND, ASIDE)), 1, 0)
    assert found.ends == [End(ANYMAL, "out", THEIR_ROVER, 1.0, inside=True)]
    assert found.numbers["at legs"][THEIR_ROVER] == 1.0
    assert found.numbers["driving at legs"][THEIR_ROVER] == 1.0
    assert found.numbers["towards anymal"][THEIR_ROVER] == 1.0
    assert found.numbers["closing on anymal"][THEIR_ROVER] == pytest.approx(2.55 / 2.4 * 0.894, abs=0.01)
    assert (found.numbers["near"][ANYMAL], found.numbers["at legs"][ANYMAL]) == (1.0, 0.0)  # a rover has no legs
    assert found.numbers["near"][ROVER] == 0.0
    assert found.numbers["outer fifth"][ANYMAL] == pytest.approx(5 / 13)  # of 13 moments those above 3.2 m


def test_an_anymal_that_walks_a_rover_out(arena, record):
    found = Observer(arena).game(record(outwards(THEIR_ROVER, ANYMAL, BEHIND, ASIDE)), 0, 0)
    assert found.ends == [End(THEIR_ROVER, "out", ANYMAL, 1.0, inside=True)]
    assert found.numbers["towards leatherback"][ANYMAL] == 1.0


def test_a_rover_without_contact_leaves_by_itself(arena, record):
    observer = Observer(arena)
    assert observer.game(record(outwards(ROVER, THEIR_ANYMAL, 1.2, 0.0)), 0, 0).ends[0].by is None
    assert observer.game(record(outwards(ROVER, ANYMAL, BEHIND, ASIDE)), 0, 0).ends[0].by == ANYMAL  # its team-mate


def test_a_touch_of_more_than_a_second_ago_does_not_count(arena, record):
    places = outwards(ANYMAL, THEIR_ROVER, BEHIND, ASIDE)
    for left, by in ((52, None), (48, THEIR_ROVER)):  # control steps before the end: a second has 50
        apart = places.copy()
        apart[-left:, THEIR_ROVER] = FAR[THEIR_ROVER]
        (end,) = Observer(arena).game(record(apart), 0, 0).ends
        assert end.by == by


def test_an_anymal_that_falls_over_a_rover(arena, record):
    places = outwards(ANYMAL, THEIR_ROVER, BEHIND, ASIDE)[:60]
    (end,) = Observer(arena).game(record(places, low=[ANYMAL]), 0, 0).ends
    assert (end.loser, end.how, end.by) == (ANYMAL, "fallen", THEIR_ROVER)


def test_time_up_has_no_end(arena, record):
    assert Observer(arena).game(record(outwards(ANYMAL, None, 0.0, 0.0)[:60]), 0, 0).ends == []


def test_clips_show_the_named_ends_and_the_commonest_other_that_newest_policies_made(record):
    recording = record(outwards(ANYMAL, THEIR_ROVER, BEHIND, ASIDE), sides=("1:red-0", "1:red"))
    lost = record(outwards(ANYMAL, THEIR_ROVER, BEHIND, ASIDE), sides=("1:red", "1:red-0"))
    chosen = Examples()
    weak = End(ANYMAL, "out", THEIR_ROVER, 0.2, inside=True)
    for end in (weak, weak._replace(contact=0.9), weak._replace(contact=1.0, inside=False)):
        chosen.add(game(end), recording, ("1:red", "1:red-0"))
    chosen.add(game(weak._replace(contact=1.0)), lost, ("1:red", "1:red-0"))  # an initial policy won
    for by in (None, None, THEIR_ANYMAL):
        chosen.add(game(End(ANYMAL, "out", by, 0.0, inside=False)), recording, ("1:red", "1:red-0"))
    assert chosen.chosen() == [("anymal", "leatherback"), ("anymal", NOBODY)]
    assert chosen.counts["anymal", "leatherback"] == 3
    assert chosen.best["anymal", "leatherback"].end.contact == 0.9
