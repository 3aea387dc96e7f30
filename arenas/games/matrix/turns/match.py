"""The common part of games of turns: two seats, one of which acts in each decision.

Each episode draws which team has seat 0, so that equal teams may change places and a policy plays both seats. The agent
whose turn it is is the only one in the game (`alive`): the other observes zeros, and learns nothing from that decision.

| what         |                                                                                              |
|--------------|----------------------------------------------------------------------------------------------|
| observation  | the seat, and what the player knows: own card or stones, and what has been seen of the rest    |
| action       | one number per choice; the largest among the legal choices is taken                            |
| reward       | `payoff`: the return at the end of the game, for the other team its negative                   |
| score        | by `rules.score`: the winner's, or a lottery by the return                                     |

Rules, seats, and returns are those of OpenSpiel; `matchmaking/extensive_games/` has the same games in plain Python, for
exact best responses, and `tests/league/matches/test_exact_exploitability.py` compares the two.
"""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple, Unpack

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions
from arenas.description import Legend, Part
from arenas.games.matrix.turns.settings import GAMES, TEAMS, TurnSettings
from arenas.physics.engine import Physics
from arenas.robots.robot import Robot, Script, random_script
from arenas.state import Verdict


class Turns(NamedTuple):
    """The numbers of an episode."""

    second_first: Array  # () bool: the second team has seat 0
    lot: Array  # () uniform in [0, 1), which decides a lottery
    choice: Array  # () int: the latest choice
    hand: Any  # the game's own


class TurnGame(Arena):
    """A zero-sum game of two seats. A game implements the hooks of the first section, for the seats 0 and 1."""

    by_turns = True

    most: float
    """The most that can be won."""

    def __init__(self, settings: TurnSettings, **options: Unpack[EngineOptions]):
        rules, game = settings.rules, GAMES[settings.rules.game]
        number = len(game.choices)
        scripts = {choice: _prefers(i, number) for i, choice in enumerate(game.choices)}
        scripts["random"] = random_script(number)
        acts = tuple(Part(c, 1, "", "the largest of the legal choices' numbers is the choice") for c in game.choices)
        robot = Robot(game.kind, number, scripts=scripts, action_parts=acts)
        super().__init__(
            settings.name, {team: (robot,) for team in TEAMS}, settings.timing, asdict(rules),
            marker_kinds={"choice": "circle"}, **options,
        )  # fmt: skip
        self.exchangeable = True
        self.choices, self.chips, self._size = game.choices, rules.score == "chips", game.observation_size

    # Hooks of a game of turns ----------------------------------------------------------------------------------------

    @abstractmethod
    def draw(self, key: Array) -> Array:
        """Draw the outcomes of chance of an episode, (n,) int; (0,) if there are none."""

    @abstractmethod
    def start(self, outcomes: Array) -> Any:
        """Return the start of the game with these outcomes of chance."""

    @abstractmethod
    def mover(self, hand: Any) -> Array:
        """Return the seat that acts, () int."""

    @abstractmethod
    def legal(self, hand: Any) -> Array:
        """Return (choices,) bool: what the seat that acts may choose."""

    @abstractmethod
    def play(self, hand: Any, choice: Array) -> Any:
        """Return the game after a choice."""

    @abstractmethod
    def outcome(self, hand: Any) -> tuple[Array, Array]:
        """Return () bool, the game is over, and () the return of seat 0 if it is."""

    @abstractmethod
    def view(self, hand: Any, seat: int) -> Array:
        """Return what a seat knows of the game, (n,)."""

    @abstractmethod
    def view_parts(self) -> tuple[Part, ...]:
        """Describe what a seat knows of the game."""

    # For exact analysis ----------------------------------------------------------------------------------------------

    def seen(self, hand: Any, seat: int) -> Array:
        """Return the observation of the agent in a seat, (observation_size,)."""
        return jnp.concatenate([jnp.array([1.0 - seat]), self.view(hand, seat)])

    def after(self, outcomes: Array, choices: Array) -> Any:
        """Return the game after outcomes of chance (n,) and choices (decisions,), which end with the first -1."""

        def step(hand: Any, choice: Array) -> tuple[Any, None]:
            played = self.play(hand, jnp.maximum(choice, 0))
            return jax.tree.map(lambda new, old: jnp.where(choice < 0, old, new), played, hand), None

        return jax.lax.scan(step, self.start(outcomes), choices)[0]

    # The contract ----------------------------------------------------------------------------------------------------

    def observation_size(self, agent: str) -> int:
        """Return the size of the observation."""
        return self._size

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the observation."""
        return (Part("seat", 1, "", "1 for the seat that acts first, 0 for the other"), *self.view_parts())

    def legend(self) -> Legend:
        """Describe reward and score."""
        score = "1 for the team that won something, ½ each where neither did"
        if self.chips:
            score = f"a lottery, won with probability ½ + return / {2 * self.most:g}"
        return Legend(score=score, rewards={"payoff": "the return at the end of the game, for the other its negative"})

    def place(self, key: Array) -> tuple[Array, Array, Turns]:
        """Draw the seats, the outcomes of chance and the lottery's number."""
        seats, chance, lot = jax.random.split(key, 3)
        hand = self.start(self.draw(chance))
        turns = Turns(jax.random.bernoulli(seats), jax.random.uniform(lot), jnp.zeros((), jnp.int32), hand)
        return jnp.zeros(0), jnp.zeros(0), turns

    def exchange(
        self, qpos: Array, qvel: Array, game: Turns, order: Sequence[int] = (1, 0)
    ) -> tuple[Array, Array, Turns]:
        """Exchange the seats of the teams."""
        return qpos, qvel, game._replace(second_first=~game.second_first)

    def alive(self, physics: Physics, game: Turns) -> Array:
        """Return (2,) bool: the agent whose turn it is."""
        first = self.mover(game.hand) == 0
        return jnp.stack([first, ~first]) ^ game.second_first

    def decide(self, game: Turns, actions: dict[str, Array]) -> Turns:
        """Record the choice of the agent whose turn it is: the legal one with the largest number."""
        numbers = jnp.stack([actions[agent] for agent in self.robots])
        own = numbers[(self.mover(game.hand) != 0) ^ game.second_first.astype(int)]
        choice = jnp.argmax(jnp.where(self.legal(game.hand), own, -jnp.inf))
        return game._replace(choice=choice.astype(jnp.int32))

    def observe(self, physics: Physics, game: Turns, actions: dict[str, Array]) -> dict[str, Array]:
        """Return what both know; the contract hides it from the agent whose turn it is not."""
        seats = jnp.stack([self.seen(game.hand, 0), self.seen(game.hand, 1)])
        by_team = jnp.where(game.second_first, seats[::-1], seats)
        return {agent: by_team[i] for i, agent in enumerate(self.robots)}

    def judge(self, before: Physics, physics: Physics, game: Turns) -> tuple[Turns, Verdict]:
        """Play the choice; the end of the game decides."""
        game = game._replace(hand=self.play(game.hand, game.choice))
        over, gain = self.outcome(game.hand)
        side = jnp.where(game.second_first, -1.0, 1.0) * jnp.array([1.0, -1.0])
        score = 0.5 + 0.5 * jnp.sign(gain) * side
        if self.chips:
            won = game.lot < 0.5 + gain / (2 * self.most)  # by seat 0
            score = 0.5 + 0.5 * jnp.where(won, 1.0, -1.0) * side
        rewards = {"payoff": jnp.where(over, gain, 0.0) * side}
        return game, Verdict(rewards, {}, score, terminated=over, truncated=jnp.zeros((), bool))

    def privileged(self, physics: Physics, game: Turns, actions: dict[str, Array]) -> Array:
        """Return whose turn it is, the first team's seat, and what both seats know."""
        now = jnp.stack([self.mover(game.hand).astype(jnp.float32), game.second_first.astype(jnp.float32)])
        return jnp.concatenate([now, self.view(game.hand, 0), self.view(game.hand, 1)])

    def privileged_parts(self) -> tuple[Part, ...]:
        """Describe the full state."""
        both = Part("views", 2 * (self._size - 1), "", "what both seats know, seat 0 first")
        return (Part("mover", 1, "", "the seat that acts"), Part("seats", 1, "", "1 if red has seat 0"), both)

    def markers(self, physics: Physics, game: Turns) -> dict[str, Array]:
        """Return the latest choice as a disc in a row of all choices."""
        first = (len(self.choices) - 1) / 2
        return {"choice": jnp.stack([jnp.zeros(()), first - game.choice, jnp.float32(0.3)])}


def _prefers(choice: int, choices: int) -> Script:
    """Make a script that makes this choice where it is legal, else the first legal one."""
    action = jax.nn.one_hot(choice, choices)
    return lambda observation, key: action
