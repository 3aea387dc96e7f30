"""Training games that are folded once, beside the whole log folded again at each plan: equal to the last bit."""

from dataclasses import replace
from itertools import groupby

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.scheduling import game_folds
from league.scheduling.opponent_sampling import qualities, records
from league.state.league_state import LeagueState
from league.state.training_games import TrainingGames
from matchmaking.opponents import Opponents, Qualities, WinRecords
from storage.records import Player
from tests.league.leagues import games, player, snapshot

PLAYERS = player("blue", 0), player("blue-2", 0, group="2"), player("red", 1), player("red-2", 1, group="2")
NAMES = [p.name for p in PLAYERS]
RULE = Opponents("pfsp", decay=0.97, shrinkage=7.0)
QUALITY = Opponents("openai_five", rate=0.013)


def played_by(state: LeagueState, learner: Player, since: int):
    """The games that count for a learner, one by one, with those of whom it was copied from."""
    if since >= 0:
        return [m for m in state.meetings if m.player == learner.name and m.iteration > since]
    mates = {p.name for p in state.players if p.team == learner.team}
    name, before, found = learner.name, float("inf"), []
    for _ in range(len(state.snapshots) + 1):
        copies = [
            (s.iteration, source)
            for s in state.history(name)
            if s.iteration <= before and (source := state.by_name.get(s.parent or "")) is not None
            if source.player in mates - {name}
        ]
        last, source = copies[-1] if copies else (-1, None)
        found = [m for m in state.meetings if m.player == name and last < m.iteration <= before] + found
        if source is None or source.player is None:
            break
        name, before = source.player, source.iteration
    return found


def all_win_rates(state, learner, since):
    known = WinRecords(RULE.decay, RULE.shrinkage, state.parents)
    for game in played_by(state, learner, since):
        known.note(game.opponent, game.wins, game.draws, game.losses)
    return known.row, known.met


def all_qualities(state, learner, since, names):
    known = Qualities(QUALITY.rate)
    drawn = [m for m in played_by(state, learner, since) if m.pool and m.opponent in names]
    for _, group in groupby(drawn, key=lambda m: m.iteration):
        turn = list(group)
        known.add(names[: turn[0].pool])
        rows = [(m.opponent, m.wins + m.draws / 2, m.wins + m.draws + m.losses, m.chance) for m in turn]
        known.note(rows, turn[0].pool)
    return known.of(names).tolist()


# Few names, so that games, snapshots and their parents are often of the same players.
iterations = st.integers(0, 4)
frozen_names = st.tuples(st.sampled_from(NAMES[:3]), iterations).map("{0[0]}@{0[1]}".format)
game = st.builds(
    lambda who, at, pool, opponent, wins, losses: games(
        opponent, wins, losses, 1, iteration=at, who=who, pool=pool, chance=1 / (1 + pool)
    ),
    st.sampled_from(NAMES[:2]), iterations, st.integers(0, 5),
    st.one_of(st.sampled_from(["red", "red@0", "red@2"]), frozen_names), st.integers(0, 9), st.integers(0, 9),
)  # fmt: skip
frozen = st.tuples(st.sampled_from(PLAYERS[:3]), iterations, frozen_names)
change = st.one_of(
    st.lists(game, min_size=1, max_size=4),
    frozen,
    st.sampled_from(["restart", "look back", "add without keeping", "lose"]),
)

FIRST = [(PLAYERS[2], 0, "none"), (PLAYERS[2], 2, "red@0"), (PLAYERS[2], 4, "red@2"), (PLAYERS[1], 0, "none")]


@settings(deadline=None, max_examples=200)
@given(st.lists(change, min_size=2, max_size=12), iterations)
def test_games_that_are_folded_once_give_what_all_games_give(changes, since):
    """Games come late and in any order, snapshots continue others of any player, and readers look back or restart."""
    log, snapshots, kept, earlier = [], {}, TrainingGames(), TrainingGames()

    def check(held, meetings):
        order = sorted(snapshots.values(), key=lambda s: (s.iteration, s.name))
        state = LeagueState(PLAYERS, order, meetings=held)
        whole = replace(state, meetings=meetings)
        assert list(held) == meetings
        for learner in PLAYERS[:2]:
            names = tuple(s.name for s in order if s.roster == learner.roster and s.player != learner.name)
            for begun in (-1, since):
                known = records(RULE, state, learner, begun)
                assert (known.row, known.met) == all_win_rates(whole, learner, begun)
                found = qualities(QUALITY, state, learner, names, begun).tolist()
                assert found == all_qualities(whole, learner, begun, names)

    for what in (*FIRST, *changes):
        if isinstance(what, list):
            earlier, log = kept, log + what
            kept = kept.extended(what)
        elif what == "restart":
            kept = TrainingGames(log)
        elif what == "look back":
            check(earlier, log[: len(earlier)])
        elif what == "add without keeping":
            more = [games("red@1", 3, 1, iteration=30), games("blue", 2, 0, iteration=1, who="red")]
            check(kept.extended(more), log + more)
        elif what == "lose":
            snapshots.pop(next(iter(snapshots), ""), None)
        else:
            owner, iteration, parent = what
            new = snapshot(owner, iteration, parent=parent)
            snapshots.setdefault(new.name, new)
        check(kept, log)


def state_of(log, *snapshots):
    return LeagueState(PLAYERS, snapshots, meetings=log)


def rows_noted(monkeypatch):
    noted = []
    note = WinRecords.note
    monkeypatch.setattr(WinRecords, "note", lambda self, *given: (noted.append(given[0]), note(self, *given))[1])
    return noted


def test_a_plan_folds_only_the_games_that_are_new_to_it(monkeypatch):
    noted = rows_noted(monkeypatch)
    blue, log = PLAYERS[0], TrainingGames(games("red@0", i, 1, iteration=i) for i in range(50))
    first = snapshot(PLAYERS[2], 0)
    records(RULE, state_of(log, first), blue)
    assert len(noted) == 50
    log = log.extended([games("red", 1, 2, iteration=51)])
    newer = snapshot(PLAYERS[2], 8, parent="red@0")
    records(RULE, state_of(log, first, newer), blue)
    assert noted[50:] == ["red"]


def test_a_reset_of_a_present_opponent_begins_the_fold_again(monkeypatch):
    noted = rows_noted(monkeypatch)
    blue, red = PLAYERS[0], PLAYERS[2]
    log = TrainingGames([games("red@0", 30, 0), games("red@4", 0, 30), games("red", 1, 1)])
    first, last = snapshot(red, 0), snapshot(red, 4)
    before = records(RULE, state_of(log, first, last), blue)
    reset = snapshot(red, 6, parent="red@0")
    after = records(RULE, state_of(log, first, last, reset), blue)
    assert len(noted) == 6
    assert before.against("red").rate < 0.4 < 0.6 < after.against("red").rate


def test_records_stay_as_they_were_when_further_games_are_folded():
    log = TrainingGames([games("red@0", 30, 0)])
    known = records(RULE, state_of(log), PLAYERS[0])
    rate = known.against("red@0").rate
    records(RULE, state_of(log.extended([games("red@0", 0, 90, iteration=2)])), PLAYERS[0])
    assert known.against("red@0").rate == rate
    assert known.met == {"red@0": 30}


def test_of_a_player_few_folds_are_kept():
    log = TrainingGames([games("red@0", 30, 0, iteration=40)])
    for since in range(20):
        records(RULE, state_of(log), PLAYERS[0], since)
    assert len(log.folds._kept["blue"]) == 4
    assert not log.folds._kept["red"]


@pytest.mark.parametrize("wins", [2**31 - 1, 2**31, 2**40])
def test_counts_of_any_size_are_kept(wins):
    log = TrainingGames([games("red@0", 1, 2)])
    longer = log.extended([games("red@0", wins, 0, iteration=2)])
    assert [m.wins for m in longer] == [1, wins]
    assert longer[-1] == games("red@0", wins, 0, iteration=2)
    assert list(log) == [longer[0]] == longer[:1]
    assert game_folds.win_records(longer, "blue", [game_folds.Part("blue")], {}, 1.0, 0.0).met["red@0"] == wins + 3
