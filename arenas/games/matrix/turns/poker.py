"""Kuhn and Leduc poker as arenas; `arenas.games.matrix.turns.match` has the common part."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from arenas.description import Part
from arenas.games.matrix.turns.match import TurnGame

PASS, BET = 0, 1
FOLD, CALL, RAISE = 0, 1, 2
RANKS, ROUNDS, SLOTS = 3, 2, 4  # of Leduc poker: a round has at most four actions
MOST_RAISES = 2  # of a round


class KuhnHand(NamedTuple):
    """A hand of Kuhn poker."""

    cards: Array  # (2,) int, 0 to 2, by seat
    played: Array  # (3,) int, -1 where nothing was played yet
    taken: Array  # () int: choices so far


class Kuhn(TurnGame):
    """Three cards, one for each player; one chip as ante, one as bet."""

    most = 2.0

    def draw(self, key: Array) -> Array:
        """Deal two of three cards."""
        return jax.random.permutation(key, 3)[:2]

    def start(self, outcomes: Array) -> KuhnHand:
        """Return the hand before any choice."""
        return KuhnHand(outcomes.astype(jnp.int32), jnp.full(3, -1, jnp.int32), jnp.zeros((), jnp.int32))

    def mover(self, hand: KuhnHand) -> Array:
        """Return the seat that acts: they take turns."""
        return hand.taken % 2

    def legal(self, hand: KuhnHand) -> Array:
        """Return that both choices are legal."""
        return jnp.ones(2, bool)

    def play(self, hand: KuhnHand, choice: Array) -> KuhnHand:
        """Return the hand after a choice."""
        return KuhnHand(hand.cards, hand.played.at[hand.taken].set(choice, mode="drop"), hand.taken + 1)

    def outcome(self, hand: KuhnHand) -> tuple[Array, Array]:
        """Return the end: two choices, but for pass and bet, or three. Who passes after a bet loses the ante."""
        answered = (hand.played[0] == PASS) & (hand.played[1] == BET)
        over = hand.taken >= jnp.where(answered, 3, 2)
        last = hand.played[hand.taken - 1]
        bet = hand.played[hand.taken - 2] == BET
        folded = jnp.where(hand.taken == 2, 1.0, -1.0)  # seat 1 has passed after two choices, seat 0 after three
        higher = jnp.sign(hand.cards[0] - hand.cards[1]).astype(jnp.float32)
        return over, jnp.where(bet & (last == PASS), folded, higher * jnp.where(last == BET, 2.0, 1.0))

    def view(self, hand: KuhnHand, seat: int) -> Array:
        """Return the own card and all choices, one-hot."""
        card = jax.nn.one_hot(hand.cards[seat], 3)
        return jnp.concatenate([card, jax.nn.one_hot(hand.played, 2).ravel()])

    def view_parts(self) -> tuple[Part, ...]:
        """Describe the view."""
        return (
            Part("card", 3, "", "one-hot: the own card, the lowest first"),
            Part("choices", 6, "", "one-hot: pass or bet, of three choices; zeros where nobody has chosen yet"),
        )


class LeducHand(NamedTuple):
    """A hand of Leduc poker."""

    cards: Array  # (3,) int, 0 to 5: seat 0's, seat 1's, the public one; the rank is half of the number
    played: Array  # (2, 4) int by round, -1 where nothing was played yet
    counts: Array  # (2,) int by round
    stage: Array  # () int: the round
    stakes: Array  # (2,) chips of each seat in the pot
    raises: Array  # () int, in this round
    folded: Array  # () int: the seat that has folded, -1: neither
    over: Array  # () bool


class Leduc(TurnGame):
    """Six cards of three ranks; two rounds of bets, with a public card between them."""

    most = 13.0

    def draw(self, key: Array) -> Array:
        """Deal three of six cards."""
        return jax.random.permutation(key, 2 * RANKS)[:3]

    def start(self, outcomes: Array) -> LeducHand:
        """Return the hand before any action: one chip each in the pot."""
        none = jnp.zeros((), jnp.int32)
        return LeducHand(
            outcomes.astype(jnp.int32), jnp.full((ROUNDS, SLOTS), -1, jnp.int32), jnp.zeros(ROUNDS, jnp.int32), none,
            jnp.ones(2), none, none - 1, jnp.zeros((), bool),
        )  # fmt: skip

    def mover(self, hand: LeducHand) -> Array:
        """Return the seat that acts: seat 0 begins both rounds."""
        return hand.counts[hand.stage] % 2

    def legal(self, hand: LeducHand) -> Array:
        """Return that one can fold if there is a bet, call, and raise at most twice in a round."""
        return jnp.stack([hand.stakes[0] != hand.stakes[1], jnp.ones((), bool), hand.raises < MOST_RAISES])

    def play(self, hand: LeducHand, choice: Array) -> LeducHand:
        """Return the hand after an action."""
        seat, stage = self.mover(hand), hand.stage
        played = hand.played.at[stage, hand.counts[stage]].set(choice, mode="drop")
        counts = hand.counts.at[stage].add(1)
        raised = (choice == RAISE).astype(jnp.int32)
        stake = jnp.where(choice == FOLD, hand.stakes[seat], hand.stakes.max() + raised * 2 * (stage + 1))
        done = (choice == CALL) & (counts[stage] >= 2)  # a call ends a round, except at its start
        second = done & (stage == 0)
        return LeducHand(
            hand.cards, played, counts, jnp.where(second, 1, stage), hand.stakes.at[seat].set(stake),
            jnp.where(second, 0, hand.raises + raised), jnp.where(choice == FOLD, seat, hand.folded),
            hand.over | (choice == FOLD) | (done & (stage == 1)),
        )  # fmt: skip

    def outcome(self, hand: LeducHand) -> tuple[Array, Array]:
        """Return the end and seat 0's chips: the other's stake, to the better hand unless one has folded."""
        rank = hand.cards // 2
        strength = rank[:2] + RANKS * (rank[:2] == rank[2])
        sign = jnp.where(hand.folded < 0, jnp.sign(strength[0] - strength[1]), jnp.where(hand.folded == 0, -1, 1))
        return hand.over, jnp.where(sign > 0, hand.stakes[1], jnp.where(sign < 0, -hand.stakes[0], 0.0))

    def view(self, hand: LeducHand, seat: int) -> Array:
        """Return the ranks of the own card and the public card, and all actions, one-hot."""
        own, public = jax.nn.one_hot(hand.cards[seat] // 2, RANKS), jax.nn.one_hot(hand.cards[2] // 2, RANKS)
        public = jnp.where(hand.stage == 1, public, 0.0)
        return jnp.concatenate([own, public, jax.nn.one_hot(hand.played, 3).ravel()])

    def view_parts(self) -> tuple[Part, ...]:
        """Describe the view."""
        return (
            Part("card", RANKS, "", "one-hot: the rank of the own card, the lowest first"),
            Part("public", RANKS, "", "one-hot: the rank of the public card; zeros in the first round"),
            Part("actions", 3 * ROUNDS * SLOTS, "", "one-hot: fold, call or raise, of four actions in each round"),
        )
