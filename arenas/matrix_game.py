"""Matrix games: the smallest arena. No bodies, no physics; what happens is what both teams chose.

| what         |                                                                                            |
|--------------|--------------------------------------------------------------------------------------------|
| observation  | one number, always 1: there is nothing to see                                              |
| action       | one number per choice; the largest is taken. A Gaussian policy so plays a mixture          |
| reward       | `payoff`: the table's entry, for red its negative, divided by the number of rounds         |
| score        | after the last round: 1 for the team that got more in all, ½ each if neither did           |
"""

from dataclasses import asdict
from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
from jax import Array

from arenas.about import Legend, Part
from arenas.arena import Arena
from arenas.matrix import SEES, TABLES, TEAMS, MatrixSettings
from arenas.options import Where
from arenas.physics import Physics
from arenas.robots.robot import Robot, Script, anything
from arenas.state import Verdict


class Rounds(NamedTuple):
    """What has been chosen and won."""

    chosen: Array  # (teams,) int, in this round
    total: Array  # () blue's payoff in all rounds


class MatrixGame(Arena):
    """Blue chooses the row, red the column."""

    def __init__(self, settings: MatrixSettings, **where: Unpack[Where]):
        rules, table = settings.rules, TABLES[settings.rules.table]
        choices = len(table.choices)
        scripts = {name: _always(i, choices) for i, name in enumerate(table.choices)}
        scripts["random"] = anything(choices)
        acts = tuple(Part(choice, 1, "", "the largest of these numbers is the choice") for choice in table.choices)
        sides = zip(TEAMS, table.kinds, strict=True)
        super().__init__(
            settings.name,
            {team: (Robot(kind, choices, scripts=scripts, action_parts=acts),) for team, kind in sides},
            settings.timing,
            asdict(rules) | {"payoff": table.payoff},
            marker_kinds=dict.fromkeys(TEAMS, "circle"),
            **where,
        )
        self.rounds, self.choices = rules.rounds, table.choices
        self.payoff = jnp.array(table.payoff, jnp.float32)

    def observation_size(self, agent: str) -> int:
        """A constant."""
        return SEES

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """A constant."""
        return (Part("one", SEES, "", "always 1: there is nothing to see, also not what was chosen before"),)

    def legend(self) -> Legend:
        """What is won."""
        rounds = "" if self.rounds == 1 else f" / {self.rounds} rounds"
        return Legend(
            score="after the last round 1 for the team that got more in all, ½ each where neither did",
            rewards={"payoff": f"every round: the table's entry{rounds}, for red its negative"},
        )

    def place(self, key: Array) -> tuple[Array, Array, Rounds]:
        """Nothing stands anywhere, and nothing is chosen yet."""
        return jnp.zeros(0), jnp.zeros(0), Rounds(jnp.zeros(2, jnp.int32), jnp.zeros(()))

    def decide(self, game: Rounds, actions: dict[str, Array]) -> Rounds:
        """The largest number is the choice."""
        chosen = jnp.stack([jnp.argmax(actions[agent]) for agent in self.robots])
        return game._replace(chosen=chosen.astype(jnp.int32))

    def observe(self, physics: Physics, game: Rounds, actions: dict[str, Array]) -> dict[str, Array]:
        """Nothing to see."""
        return {agent: jnp.ones(1) for agent in self.robots}

    def judge(self, before: Physics, physics: Physics, game: Rounds) -> tuple[Rounds, Verdict]:
        """Look the round up; the last one decides."""
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
        """The choices as discs in two columns, the first choice in front."""
        first = (len(self.choices) - 1) / 2
        rows = first - game.chosen
        return {team: jnp.stack([jnp.float32(i - 0.5), rows[i], jnp.float32(0.3)]) for i, team in enumerate(TEAMS)}


def _always(choice: int, choices: int) -> Script:
    """The script that always chooses the same."""
    action = jax.nn.one_hot(choice, choices)
    return lambda observation, key: action
