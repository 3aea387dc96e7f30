"""Whom learners meet: rules by what a store holds, read as values."""

from dataclasses import replace

import numpy as np
import pytest

from league.config import presets
from league.queries.opponents import explain_opponents
from league.scheduling import turn_scheduler
from league.scheduling.opponent_sampling import opponent_distribution, qualities, records
from league.state.league_state import LeagueState
from matchmaking.opponents import Opponents, Qualities, gaussian, pfsp
from matchmaking.ratings.ladder import Ladder
from matchmaking.roles import Role
from storage.records import Checkpoint
from storage.store import Store
from tests.league.leagues import BLUE, ITERATIONS, RED, chain, finish, games, match, player, snapshot


def league_state(*meetings, matches=(), players=(BLUE, RED), extra=(), **given) -> LeagueState:
    frozen = [snapshot(None, 0, name="rock"), *(s for p in players for s in chain(p)), *extra]
    ladder = Ladder([s.name for s in frozen], matches, [s.name for s in frozen if s.initial])
    at = {p.name: Checkpoint("cup", p.name, f"{p.name}:4", 400, 4, 4.0) for p in players}
    return LeagueState(players, frozen, at, ladder=ladder, meetings=meetings, **given)


def met(kind, state, opponent="red", learner=BLUE, **given):
    found = opponent_distribution(Opponents(kind, **given), state, learner, 1 - learner.team, opponent)
    assert found.mixture.weights.sum() == pytest.approx(1)
    return dict(zip((*found.names, opponent), found.mixture.weights.tolist(), strict=True))


def test_pfsp_reads_the_games_that_the_player_learnt_from_and_draws_are_no_losses():
    log = games("red@0", 1000, 0), games("red@1", 0, 0, 1000), games("red@2", 0, 1000), games("red@4", 500, 500)
    found = met("pfsp", league_state(*log))
    assert found == pytest.approx({"red@0": 0, "red@1": 1 / 6, "red@2": 4 / 6, "red@4": 1 / 6, "red": 0}, abs=1e-3)
    others = [replace(game, player="red", opponent=game.opponent.replace("red", "blue")) for game in log]
    assert met("pfsp", league_state(*others)) == pytest.approx({**dict.fromkeys(found, 0.25), "red": 0})


def test_a_snapshot_that_was_never_met_inherits_from_the_one_it_goes_on_from():
    state = league_state(games("red@1", 900, 100))
    known = records(Opponents("pfsp"), state, BLUE)
    assert known.rates(["red@1", "red@2", "red@4"]) == pytest.approx([0.9] * 3, abs=1e-3)
    assert known.rates(["red@0"]) == [0.5]
    assert known.against("red").rate == pytest.approx(0.9, abs=1e-3)


def test_a_player_that_goes_on_from_another_of_its_team_inherits_its_row():
    twin = player("blue-2", 0, group="2")
    log = games("red@0", 0, 500, iteration=1), games("red@0", 500, 0, iteration=4), games("red@1", 0, 500, who="blue-2")
    copied = [snapshot(twin, 0), snapshot(twin, 3, parent="blue@1")]
    state = league_state(*log, extra=copied, players=(BLUE, RED, replace(twin, name="other")))
    state = replace(state, players=(BLUE, RED, twin))
    known = records(Opponents("pfsp"), state, twin)
    assert known.rates(["red@0"])[0] < 0.01  # as blue was at iteration 1, and not what came later
    assert known.games(["red@1"]).tolist() == [0]  # its own games before the copy are another policy's


def test_qualities_follow_the_log_whatever_was_read_before():
    log = [
        games("red@0", 90, 10, iteration=1, chance=1.0, pool=1),
        games("red", 5000, 0, iteration=1),
        games("red@0", 30, 10, 20, iteration=2, chance=0.4, pool=2),
        games("red@1", 0, 60, iteration=2, chance=0.6, pool=2),
    ]
    first = -0.01 * 90
    found = qualities(Opponents("openai_five"), league_state(*log), BLUE, ("red@0", "red@1", "red@2"))
    assert found == pytest.approx([first - 0.01 * 40 / (2 * 0.5), first, first])
    assert Qualities().of(["a"]).tolist() == [0]
    weights = met("openai_five", league_state(*log))
    assert weights["red@1"] == weights["red@4"] > weights["red@0"] > 0
    assert weights["red"] == 0


def test_a_late_player_s_snapshots_begin_with_the_largest_quality_of_their_time():
    """The early snapshots of a player that came late are not as old as those of others at that iteration."""
    late = player("red-2", 1, group="2")
    order = [(RED, 0), (RED, 2), (RED, 4), (late, 1), (RED, 8), (late, 3)]
    pool = [snapshot(owner, i, created=100.0 + at) for at, (owner, i) in enumerate(order)]
    log, published = [], Qualities()
    for size in (2, 3, 5, 6):
        turn = [(s.name, 30 + 10 * at, 100, 1 / size) for at, s in enumerate(pool[:size])]
        published.add(name for name, *_ in turn)
        published.note(turn, size)
        log += [games(name, n, 100 - n, iteration=size, chance=p, pool=size) for name, n, _, p in turn]
    by_iteration = sorted(pool, key=lambda s: (s.iteration, s.name))
    names = [s.name for s in by_iteration]
    state = LeagueState((BLUE, RED, late), by_iteration, meetings=log)
    assert qualities(Opponents("openai_five"), state, BLUE, names) == pytest.approx(published.of(names))


@pytest.mark.parametrize("kind", ["uniform", "latest", "pfsp", "openai_five", "gaussian", "nash", "alpharank"])
def test_nobody_meets_a_thinned_snapshot_and_what_is_known_of_the_others_stays(kind):
    log = [games("red@0", 90, 10, chance=0.5, pool=4), games("red@2", 30, 10, chance=0.5, pool=4)]
    played = [match("blue@1", "red@2", 300, 100), match("blue@4", "red@1", 200, 200)]
    state = league_state(*log, matches=played)
    thinned = replace(state, snapshots=[replace(s, thinned=9.0) if s.name == "red@1" else s for s in state.snapshots])
    before, after = met(kind, state), met(kind, thinned)
    assert set(after) == set(before) - {"red@1"}
    if kind == "openai_five":
        assert after["red@0"] / after["red@4"] == pytest.approx(before["red@0"] / before["red@4"])


def test_predicted_scores_come_from_ratings_and_of_the_unrated_from_their_parents():
    state = league_state(matches=[match("blue@1", "red@0", 300, 100), match("blue@1", "red@1", 200, 200)])
    ladder = state.ladder.ratings
    x = [ladder.expected("blue@1", f"red@{i}") for i in (0, 1, 1, 1)]
    assert list(met("gaussian", state).values())[:-1] == pytest.approx(gaussian(np.array(x)))
    assert list(met("gaussian", league_state()).values())[:-1] == pytest.approx([0.25] * 4)


def test_the_nash_mixture_is_that_of_the_other_team():
    """Red@0, @1, @2 are rock, paper and scissors to blue's; red@4 loses to all."""
    beats = {(0, 2), (1, 0), (2, 1)}
    played = []
    for i in (0, 1, 2, 4):
        for j in (0, 1, 2, 4):
            if i == 4 or j == 4:
                score = (400, 0) if i != 4 else (0, 400) if j != 4 else (200, 200)
            else:
                score = (400, 0) if (i, j) in beats else (0, 400) if (j, i) in beats else (200, 200)
            played.append(match(f"blue@{i}", f"red@{j}", *score))
    third = pytest.approx({"red@0": 1 / 3, "red@1": 1 / 3, "red@2": 1 / 3, "red@4": 0, "red": 0}, abs=1e-6)
    assert met("nash", league_state(matches=played)) == third
    inner = [replace(m, a=m.a.replace("blue", "red")) for m in played if m.a[-1] < m.b[-1]]
    assert met("alpharank", league_state(matches=inner)) == third


def test_alphastars_mix_seats_the_present_player_among_the_drawn():
    config = presets.preset("quickstart")
    training = replace(config.training, worlds=256, opponents=Opponents("alphastar", groups=64))
    state = league_state(games("red", 300, 200))
    turn = _turn(replace(config, training=training), state)
    share = sum(row == ("", "") for row in turn.past["blue"]) / 64
    assert 0.3 < share < 0.7  # 0.35 + 0.15: nobody to be verified against
    assert all(0 < chance <= 1 and pool == 4 for chance, pool in turn.chances["blue"].values())
    assert set(turn.chances["blue"]) == {row[1] for row in turn.past["blue"]} - {""}
    weak = _turn(replace(config, training=training), league_state(games("red", 10, 400)))
    assert all(row[1] for row in weak.past["blue"])


def test_an_exploiter_that_wins_is_verified_against():
    hunter = replace(player("hunter", 1, group="2"), role="main_exploiter")
    log = [games(f"red@{i}", 90, 10) for i in ITERATIONS] + [games(f"hunter@{i}", 5, 95) for i in ITERATIONS]
    found = met("alphastar", league_state(*log, players=(BLUE, RED, hunter)))
    plain = 0.5 * pfsp(records(Opponents(), league_state(*log), BLUE).rates([f"red@{i}" for i in ITERATIONS]))
    assert found["red"] == pytest.approx(0.35)
    assert sum(p for name, p in found.items() if name.startswith("hunter")) > 0.6 > plain.sum()


def test_league_exploiters_are_met_by_pfsp_alone():
    hunter = replace(player("hunter", 1, group="2"), role="league_exploiter")
    log = [games(f"red@{i}", 90, 10) for i in ITERATIONS] + [games(f"hunter@{i}", 5, 95) for i in ITERATIONS]
    found = met("alphastar", league_state(*log, players=(BLUE, RED, hunter)))
    assert sum(p for name, p in found.items() if name.startswith("hunter")) == pytest.approx(0.5, abs=0.02)


def test_a_victim_is_always_met_by_whom_it_fits():
    assert met("fixed", league_state(), victim="rock") == {"rock": 1, "red": 0}
    assert met("fixed", league_state(), victim="red@2") == {"red@2": 1, "red": 0}
    unlike = (BLUE, replace(RED, roster="drone"))
    assert met("fixed", league_state(players=unlike), victim="rock") == {"red": 1}


def test_what_is_explained_is_what_is_drawn():
    config = presets.preset("quickstart")
    rule = Opponents("pfsp", past=0.5, groups=200)
    config = replace(config, training=replace(config.training, worlds=4096, opponents=rule))
    state = league_state(games("red@0", 100, 0), games("red@4", 20, 80))
    told = explain_opponents(Role("main", rule), state, BLUE)
    chances = {row["opponent"]: row["probability"] for row in told["teams"][0]["opponents"]}
    assert sum(chances.values()) == pytest.approx(1)
    assert chances["red"] == 0.5 == told["share"]
    drawn = [row[1] for row in _turn(config, state).past["blue"]]
    assert len(drawn) == 100
    for name in ("red@0", "red@1", "red@2", "red@4"):
        assert drawn.count(name) / 100 == pytest.approx(2 * chances[name], abs=0.17)


def _turn(config, state):
    from league.state.jobs import decode

    return decode(turn_scheduler.next_turns(replace(config, league="cup"), state).jobs[0])


def test_a_restart_reads_the_same_games_as_one_who_has_looked_all_along(tmp_path):
    with Store.open(tmp_path / "s", create=True) as store:
        from storage.records import League

        store.create_league(League("cup", ""))
        store.add_players([BLUE, RED])
        looked = LeagueState.of(store, "cup")
        for iteration in range(1, 4):
            finish(store, meetings=[games("red@0", iteration, 1, iteration=iteration), games("red", 2, 2, 2)])
            looked = LeagueState.of(store, "cup", looked)
        assert list(looked.meetings) == list(LeagueState.of(store, "cup").meetings) == store.meetings("cup")
        assert [m.wins for m in store.meetings("cup") if m.opponent == "red@0"] == [1, 2, 3]
