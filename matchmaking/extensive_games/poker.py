"""Kuhn poker (Kuhn 1950) and Leduc poker (Southey et al. 2005, "Bayes' bluff"), by the conventions of OpenSpiel."""

from collections.abc import Hashable
from typing import NamedTuple

from matchmaking.extensive_games.game import CHANCE, TERMINAL

PASS, BET = 0, 1
FOLD, CALL, RAISE = 0, 1, 2
RAISES = (2, 4)  # chips of a raise in each round of Leduc poker
MOST_RAISES = 2  # of a round
RANKS = 3


class Deal(NamedTuple):
    """A state of Kuhn poker."""

    cards: tuple[int, ...]  # 0 to 2, player 0's first
    played: tuple[int, ...]


class KuhnPoker:
    """Three cards, one for each player; one chip as ante, one as bet."""

    name = "kuhn-poker"
    actions = 2
    longest = 3

    def start(self) -> Deal:
        """Return the state before the cards are dealt."""
        return Deal((), ())

    def player(self, state: Deal) -> int:
        """Return the player who acts."""
        if len(state.cards) < 2:
            return CHANCE
        over = len(state.played) >= 2 and state.played != (PASS, BET)
        return TERMINAL if over else len(state.played) % 2

    def legal(self, state: Deal) -> list[int]:
        """Return the cards left, or pass and bet."""
        return [c for c in range(3) if c not in state.cards] if len(state.cards) < 2 else [PASS, BET]

    def play(self, state: Deal, action: int) -> Deal:
        """Return the state after a card or a choice."""
        if len(state.cards) < 2:
            return state._replace(cards=(*state.cards, action))
        return state._replace(played=(*state.played, action))

    def gain(self, state: Deal) -> float:
        """Return player 0's chips: the ante of who folds, else one or two for the higher card."""
        if state.played[-2:] == (BET, PASS):
            return 1.0 if len(state.played) == 2 else -1.0
        stake = 2.0 if state.played[-1] == BET else 1.0
        return stake if state.cards[0] > state.cards[1] else -stake

    def information(self, state: Deal, player: int) -> Hashable:
        """Return the player's card and all choices."""
        return player, state.cards[player], state.played


class Hand(NamedTuple):
    """A state of Leduc poker."""

    cards: tuple[int, ...]  # 0 to 5: player 0's, player 1's, the public card; the rank is a card's number // 2
    rounds: tuple[tuple[int, ...], ...]  # actions of each round
    stakes: tuple[int, int]  # chips that each player has in the pot
    raises: int  # in this round


class LeducPoker:
    """Six cards of three ranks; two rounds of bets, with a public card between them."""

    name = "leduc-poker"
    actions = 3
    longest = 8

    def start(self) -> Hand:
        """Return the state before the cards are dealt."""
        return Hand((), ((),), (1, 1), 0)

    def player(self, state: Hand) -> int:
        """Return the player who acts; player 0 begins both rounds."""
        if len(state.cards) < 2:
            return CHANCE
        played = state.rounds[-1]
        if played and played[-1] == FOLD:
            return TERMINAL
        if len(played) < 2 or played[-1] != CALL:  # a call ends a round, except at its start
            return len(played) % 2
        return TERMINAL if len(state.rounds) == 2 else CHANCE

    def legal(self, state: Hand) -> list[int]:
        """Return the cards left, or the player's actions: nobody folds without a bet to answer."""
        if self.player(state) == CHANCE:
            return [c for c in range(2 * RANKS) if c not in state.cards]
        fold = [FOLD] if state.stakes[0] != state.stakes[1] else []
        return [*fold, CALL, *([RAISE] if state.raises < MOST_RAISES else [])]

    def play(self, state: Hand, action: int) -> Hand:
        """Return the state after a card or an action."""
        player = self.player(state)
        if player == CHANCE:
            public = len(state.cards) == 2
            rounds, raises = ((*state.rounds, ()), 0) if public else (state.rounds, state.raises)
            return state._replace(cards=(*state.cards, action), rounds=rounds, raises=raises)
        stakes, raises = list(state.stakes), state.raises
        if action != FOLD:
            stakes[player] = max(stakes)
        if action == RAISE:
            stakes[player] += RAISES[len(state.rounds) - 1]
            raises += 1
        rounds = (*state.rounds[:-1], (*state.rounds[-1], action))
        return Hand(state.cards, rounds, (stakes[0], stakes[1]), raises)

    def gain(self, state: Hand) -> float:
        """Return the chips that player 0 wins: the other's stake, to the better hand unless one has folded."""
        played = state.rounds[-1]
        if played[-1] == FOLD:
            folded = (len(played) - 1) % 2
            return float(-state.stakes[0] if folded == 0 else state.stakes[1])
        own, other = self._strength(state, 0), self._strength(state, 1)
        return float((own > other) * state.stakes[1] - (own < other) * state.stakes[0])

    def _strength(self, state: Hand, player: int) -> int:
        """Return a pair's strength above that of any single rank."""
        rank = state.cards[player] // 2
        return RANKS + rank if rank == state.cards[2] // 2 else rank

    def information(self, state: Hand, player: int) -> Hashable:
        """Return the player's card, the public card and all actions."""
        return player, state.cards[player], state.cards[2:], state.rounds
