"""Plans of policies: their returns, and mixtures."""

import numpy as np
import pytest

from matchmaking.extensive_games.best_response import best_response_value, exploitability
from matchmaking.extensive_games.dark_hex import DarkHex
from matchmaking.extensive_games.game import CHANCE, TERMINAL, masked, situations, uniform_table
from matchmaking.extensive_games.poker import KuhnPoker, LeducPoker
from matchmaking.extensive_games.sequence_form import SequenceForm


def expected_return(game, first, second, state=None) -> float:
    """Return player 0's expected return where the players follow two tables, by the definition."""
    state = game.start() if state is None else state
    player = game.player(state)
    if player == TERMINAL:
        return game.gain(state)
    legal = game.legal(state)
    if player == CHANCE:
        shares = np.full(len(legal), 1 / len(legal))
    else:
        shares = (first, second)[player][game.information(state, player)][legal]
    return sum(
        p * expected_return(game, first, second, game.play(state, a)) for a, p in zip(legal, shares, strict=True)
    )


@pytest.fixture(scope="module", params=[KuhnPoker(), LeducPoker()], ids=lambda game: game.name)
def form(request) -> SequenceForm:
    return SequenceForm(request.param)


@pytest.fixture(scope="module")
def tables(form):
    rng, known = np.random.default_rng(0), situations(form.game)
    found = [{k: masked(rng.exponential(size=form.game.actions), s.legal) for k, s in known.items()} for _ in range(3)]
    return [*found, uniform_table(known, form.game.actions)]


def test_the_number_of_sequences_is_that_of_actions(form):
    actions = [0, 0]
    for each in situations(form.game).values():
        actions[each.player] += len(each.legal)
    assert [size - 1 for size in form.sizes] == actions


def test_returns_are_those_of_the_definition(form, tables):
    plans = [form.plans(table) for table in tables]
    found = form.payoffs(plans[:2], plans[2:])
    for i, ours in enumerate(tables[:2]):
        for j, theirs in enumerate(tables[2:]):
            mean = (expected_return(form.game, ours, theirs) - expected_return(form.game, theirs, ours)) / 2
            assert found[i, j] == pytest.approx(mean, abs=1e-12)
    assert form.payoffs(plans, plans) == pytest.approx(-form.payoffs(plans, plans).T, abs=1e-12)


def test_a_plan_leads_back_to_its_table(form, tables):
    again = form.table(form.plans(tables[0]))
    assert all(again[key] == pytest.approx(row) for key, row in tables[0].items())


def test_a_mixture_returns_the_mean_and_is_exploited_no_more_than_its_parts(form, tables):
    weights = np.array([0.5, 0.2, 0.3])
    plans = [form.plans(table) for table in tables]
    mixed = form.table(form.mixture(plans[:3], weights))
    each = [expected_return(form.game, table, tables[3]) for table in tables[:3]]
    assert expected_return(form.game, mixed, tables[3]) == pytest.approx(weights @ each)
    parts = [best_response_value(form.game, table, 1) for table in tables[:3]]
    assert best_response_value(form.game, mixed, 1) <= weights @ parts + 1e-12
    assert exploitability(form.game, mixed).nash_conv > 0


def test_exploitability_is_that_of_the_other_algorithm(form, tables):
    for table in tables:
        assert form.exploitability(form.plans(table)) == pytest.approx(exploitability(form.game, table)[1], abs=1e-12)


def test_what_a_policy_never_reaches_is_played_evenly():
    form = SequenceForm(KuhnPoker())
    table = {key: np.array([0.0, 1.0]) for key in situations(form.game)}  # always bets, so nobody answers a pass
    again = form.table(form.plans(table))
    assert again[0, 1, (0, 1)].tolist() == [0.5, 0.5]
    assert again[0, 1, ()].tolist() == [0.0, 1.0]


def test_a_game_in_which_policies_forget_is_refused():
    with pytest.raises(ValueError, match="dark-hex-2: a player forgets"):
        SequenceForm(DarkHex(2, 2))
    assert SequenceForm(DarkHex(2, 2, recall=True)).sizes[0] > 1
