"""Exact exploitability against OpenSpiel's on the same policies."""

import numpy as np
import pytest

from matchmaking.extensive_games import best_response
from matchmaking.extensive_games.best_response import best_response_value, exploitability
from matchmaking.extensive_games.dark_hex import DarkHex
from matchmaking.extensive_games.game import masked, situations, uniform_table
from matchmaking.extensive_games.poker import KuhnPoker
from tests.matchmaking.extensive_games.spiel import PAIRS, SpielGame


def random_table(known, actions, seed, zeros=0.0):
    """Return a random policy that leaves out a share of its actions."""
    rng = np.random.default_rng(seed)
    table = {}
    for key, each in known.items():
        weights = rng.exponential(size=actions) * (rng.random(actions) >= zeros)
        weights[each.legal[0]] += 0.01
        table[key] = masked(weights, each.legal)
    return table


@pytest.fixture(scope="module", params=PAIRS, ids=lambda pair: pair[0].name)
def beside(request) -> SpielGame:
    return SpielGame(*request.param)


def test_every_history_is_openspiels(beside):
    expected = {"kuhn-poker": (58, 12), "leduc-poker": (9457, 936), "dark-hex-2": (441, 134)}
    known = situations(beside.ours)
    assert (beside.nodes, len(known)) == expected[beside.ours.name]
    assert len(set(beside.information.values())) == len(beside.information)  # neither knows more than the other
    assert set(beside.information.values()) == set(known)


@pytest.mark.parametrize(("seed", "zeros"), [(None, 0.0), (1, 0.0), (2, 0.5)])
def test_exploitability_is_openspiels(beside, seed, zeros):
    known = situations(beside.ours)
    uniform = uniform_table(known, beside.ours.actions)
    table = uniform if seed is None else random_table(known, beside.ours.actions, seed, zeros)
    nash_conv, responses = beside.nash_conv(table)
    found = exploitability(beside.ours, table)
    assert found.nash_conv == pytest.approx(nash_conv, abs=1e-9)
    assert found.exploitability == pytest.approx(nash_conv / 2, abs=1e-9)
    assert found.best_response_values == pytest.approx(responses, abs=1e-9)


@pytest.mark.parametrize("alpha", [0.0, 0.2, 1 / 3])
def test_kuhns_equilibria_cannot_be_exploited(alpha):
    # Kuhn (1950): player 0 bets with the lowest card at rate α, with the highest at 3α, and calls with the middle one
    # at α + 1/3; player 1 bluffs with the lowest and calls with the middle one a third of the time.
    bets = {
        (0, 0, ()): alpha, (0, 1, ()): 0.0, (0, 2, ()): 3 * alpha,
        (0, 0, (0, 1)): 0.0, (0, 1, (0, 1)): alpha + 1 / 3, (0, 2, (0, 1)): 1.0,
        (1, 0, (0,)): 1 / 3, (1, 1, (0,)): 0.0, (1, 2, (0,)): 1.0,
        (1, 0, (1,)): 0.0, (1, 1, (1,)): 1 / 3, (1, 2, (1,)): 1.0,
    }  # fmt: skip
    found = exploitability(KuhnPoker(), {key: np.array([1 - bet, bet]) for key, bet in bets.items()})
    assert found.nash_conv == pytest.approx(0, abs=1e-12)
    assert found.best_response_values == pytest.approx((-1 / 18, 1 / 18))


@pytest.mark.parametrize("board", [(2, 2), (2, 3)])
def test_a_forgetful_policy_has_the_value_of_its_table_with_memory(board):
    """Best responses remember the order of their moves, whether or not the policy's table does."""
    forgetful, whole = DarkHex(*board), DarkHex(*board, recall=True)
    known = situations(forgetful)
    table = random_table(known, forgetful.actions, 3)
    remembered = {key: table[(*key[:4], ())] for key in situations(whole)}
    assert len(known) < len(remembered)
    found, expected = exploitability(forgetful, table), exploitability(whole, remembered)
    assert found.best_response_values == pytest.approx(expected.best_response_values, abs=1e-12)


def test_the_size_of_a_batch_changes_nothing(monkeypatch):
    game = DarkHex(2, 3)
    table = random_table(situations(game), game.actions, 4)
    expected = best_response_value(game, table, 0)
    monkeypatch.setattr(best_response, "AT_ONCE", 50)
    assert best_response_value(game, table, 0) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("row", "says"), [([np.nan, 0.5], "not finite"), ([0.6, 0.6], "0.6, 0.6"), ([-0.5, 1.5], "-0.5, 1.5")]
)
def test_rows_that_are_no_probabilities_are_refused(row, says):
    game = KuhnPoker()
    table = uniform_table(situations(game), 2) | {(0, 1, ()): np.array(row)}
    with pytest.raises(ValueError, match=says):
        exploitability(game, table)


@pytest.mark.slow
def test_dark_hex_on_six_cells_is_openspiels():
    game = DarkHex(2, 3, recall=True)
    beside = SpielGame(game, "dark_hex(num_rows=2,num_cols=3)")
    table = random_table(situations(game), game.actions, 5)
    nash_conv, responses = beside.nash_conv(table)
    found = exploitability(game, table)
    assert found.nash_conv == pytest.approx(nash_conv, abs=1e-9)
    assert found.best_response_values == pytest.approx(responses, abs=1e-9)


@pytest.mark.parametrize(
    ("responder", "value"),
    [pytest.param(0, 1.0, marks=pytest.mark.gpu), pytest.param(1, 0.8328042328042329, marks=pytest.mark.slow)],
)
def test_dark_hex_on_nine_cells_is_solved_in_seconds(responder, value):
    """The first player has a sure win against anybody; the second one wins 92 % against random play."""
    game = DarkHex(3, 3)
    assert best_response_value(game, uniform_table(situations(game), 9), responder) == pytest.approx(value, abs=1e-9)
