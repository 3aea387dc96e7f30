"""Our games beside OpenSpiel's: the same histories, and tables of probabilities carried over."""

from collections.abc import Hashable, Mapping

import numpy as np
import pyspiel
from open_spiel.python import policy as spiel_policy
from open_spiel.python.algorithms import exploitability as spiel_exploitability

from matchmaking.extensive_games.dark_hex import DarkHex
from matchmaking.extensive_games.game import CHANCE, TERMINAL, ExtensiveGame
from matchmaking.extensive_games.poker import KuhnPoker, LeducPoker

PAIRS = (
    (KuhnPoker(), "kuhn_poker"),
    (LeducPoker(), "leduc_poker"),
    (DarkHex(2, 2, recall=True), "dark_hex(num_rows=2,num_cols=2)"),
)


class SpielGame:
    """A game of OpenSpiel and the information states of ours that are its own."""

    def __init__(self, ours: ExtensiveGame, name: str):
        """Play every history in both, and compare who acts, what is legal, what chance does and what is won."""
        self.ours, self.theirs = ours, pyspiel.load_game(name)
        self.information: dict[str, Hashable] = {}  # theirs -> ours
        self.nodes = 0
        self._compare(ours.start(), self.theirs.new_initial_state())

    def _compare(self, ours, theirs) -> None:
        self.nodes += 1
        player = self.ours.player(ours)
        if theirs.is_terminal():
            assert player == TERMINAL
            assert theirs.returns() == [self.ours.gain(ours), -self.ours.gain(ours)]
            return
        if theirs.is_chance_node():
            legal = list(self.ours.legal(ours))
            assert player == CHANCE
            assert theirs.chance_outcomes() == [(outcome, 1 / len(legal)) for outcome in legal]
        else:
            assert player == theirs.current_player()
            assert list(self.ours.legal(ours)) == theirs.legal_actions()
            known = self.ours.information(ours, player)
            assert self.information.setdefault(theirs.information_state_string(), known) == known
        for action in self.ours.legal(ours):
            self._compare(self.ours.play(ours, action), theirs.child(action))

    def nash_conv(self, table: Mapping[Hashable, np.ndarray]) -> tuple[float, list[float]]:
        """Return OpenSpiel's NashConv of our table, and the values of best responses to it."""
        policy = spiel_policy.TabularPolicy(self.theirs)
        for state, row in policy.state_lookup.items():
            policy.action_probability_array[row] = table[self.information[state]]
        found = spiel_exploitability.nash_conv(self.theirs, policy, return_only_nash_conv=False)
        on_policy = sum(found.player_improvements) - found.nash_conv
        assert abs(on_policy) < 1e-12
        responses = [
            spiel_exploitability.best_response(self.theirs, policy, player)["best_response_value"] for player in (0, 1)
        ]
        return found.nash_conv, responses
