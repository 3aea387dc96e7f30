"""Matrix games: the smallest arenas. They have no bodies and no physics; the choices of both teams decide.

| what         |                                                                                            |
|--------------|--------------------------------------------------------------------------------------------|
| observation  | one number, always 1: nothing is observed                                                  |
| action       | one number per choice; the largest is taken. A Gaussian policy so plays a mixture          |
| reward       | `payoff`: the table's entry, for red its negative, divided by the number of rounds         |
| score        | after the last round: 1 for the team that got more in all, ½ each if neither did           |
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions
from arenas.description import Legend, Part
from arenas.games.matrix.settings import OBSERVATION_SIZE, TABLES, TEAMS, MatrixSettings
from arenas.physics.engine import Physics
from arenas.robots.robot import Robot, Script, random_script
from arenas.state import Verdict


class Rounds(NamedTuple):
    """The choices and winnings of an episode."""

    chosen: Array  # (teams,) int, in this round
    total: Array  # () blue's payoff in all rounds


class MatrixGame(Arena):
    """Blue chooses the row, red the column."""

    def __init__(self, settings: MatrixSettings, **options: Unpack[EngineOptions]):
        rules, table = settings.rules, TABLES[settings.rules.table]
        choices = len(table.choices)
        scripts = {name: _always(i, choices) for i, name in enumerate(table.choices)}
        scripts["random"] = random_script(choices)
        acts = tuple(Part(choice, 1, "", "the largest of these numbers is the choice") for choice in table.choices)
        sides = zip(TEAMS, table.kinds, strict=True)
        super().__init__(
            settings.name,
            {team: (Robot(kind, choices, scripts=scripts, action_parts=acts),) for team, kind in sides},
            settings.timing,
            asdict(rules) | {"payoff": table.payoff},
            marker_kinds=dict.fromkeys(TEAMS, "circle"),
            **options,
        )
        self.rounds, self.choices = rules.rounds, table.choices
        self.payoff = jnp.array(table.payoff, jnp.float32)
        self.exchangeable = bool((self.payoff == -self.payoff.T).all())  # red's table is then blue's

    def observation_size(self, agent: str) -> int:
        """Return the size of the constant observation."""
        return OBSERVATION_SIZE

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the constant observation."""
        return (Part("one", OBSERVATION_SIZE, "", "always 1: nothing is observed, not even earlier choices"),)

    def legend(self) -> Legend:
        """Describe the payoff."""
        rounds = "" if self.rounds == 1 else f" / {self.rounds} rounds"
        return Legend(
            score="after the last round 1 for the team that got more in all, ½ each where neither did",
            rewards={"payoff": f"every round: the table's entry{rounds}, for red its negative"},
        )

    def place(self, key: Array) -> tuple[Array, Array, Rounds]:
        """Return a start without bodies and without choices."""
        return jnp.zeros(0), jnp.zeros(0), Rounds(jnp.zeros(2, jnp.int32), jnp.zeros(()))

    def exchange(
        self, qpos: Array, qvel: Array, game: Rounds, order: Sequence[int] = (1, 0)
    ) -> tuple[Array, Array, Rounds]:
        """Exchange the teams' choices and winnings."""
        return qpos, qvel, Rounds(game.chosen[jnp.array(order)], -game.total)

    def decide(self, game: Rounds, actions: dict[str, Array]) -> Rounds:
        """Record each team's choice: the index of its largest number."""
        chosen = jnp.stack([jnp.argmax(actions[agent]) for agent in self.robots])
        return game._replace(chosen=chosen.astype(jnp.int32))

    def observe(self, physics: Physics, game: Rounds, actions: dict[str, Array]) -> dict[str, Array]:
        """Return the constant 1 for both agents."""
        return {agent: jnp.ones(1) for agent in self.robots}

    def judge(self, before: Physics, physics: Physics, game: Rounds) -> tuple[Rounds, Verdict]:
        """Look up the payoff of the round; the last round ends the match."""
        won = self.payoff[game.chosen[0], game.chosen[1]]
        total = game.total + won
        sides = jnp.array([1.0, -1.0])
        return game._replace(total=total), Verdict(
            rewards={"payoff": won * sides / self.rounds},
            shapings={},
            score=0.5 + 0.5 * jnp.sign(total) * sides,
            terminated=physics.time > self.rounds - 0.5,
            truncated=jnp.zeros((), bool),
        )

    def markers(self, physics: Physics, game: Rounds) -> dict[str, Array]:
        """Return the choices as discs in two columns, the first choice in front."""
        first = (len(self.choices) - 1) / 2
        rows = first - game.chosen
        return {team: jnp.stack([jnp.float32(i - 0.5), rows[i], jnp.float32(0.3)]) for i, team in enumerate(TEAMS)}


def _always(choice: int, choices: int) -> Script:
    """Make a script that always makes this choice."""
    action = jax.nn.one_hot(choice, choices)
    return lambda observation, key: action
