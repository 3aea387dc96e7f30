"""Tag, free for all: all chase the one that is "it", and whoever is "it" for the longest time wins.

| term of the reward | when                | "it"                               | the others                        |
|--------------------|---------------------|------------------------------------|-----------------------------------|
| rank               | time is up          | from +rank for the first to -rank for the last, whoever is "it" then   |
| it                 | every control step  | +it × seconds                      | -it × seconds, shared             |
| approach (hint)    | every control step  | +approach × metres gained on the   | +approach × metres nearer to "it" |
|                    |                     | nearest other                      |                                   |

Events: `tag` of the puck that touched "it" and is "it" from then on, `tagged` of the one that was.

Who is "it" first is drawn. For a while after a touch none counts, so that the new one can get away. The clock is a
rule: its end is terminal, and it is observed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions, Solver
from arenas.description import Legend, Part
from arenas.games.tag import observation, scripts
from arenas.games.tag.settings import KIND, START, TEAMS, TagSettings
from arenas.physics.engine import Physics
from arenas.robots.puck import puck
from arenas.robots.robot import Script
from arenas.scene import props
from arenas.state import Verdict, mean_pairwise_score

HEIGHT = 0.12  # m, of walls


class GameState(NamedTuple):
    """The puck that is "it", and the time of each as "it"."""

    it: Array  # () int32, a team's number
    held: Array  # (teams,) int32, control steps as "it"
    counts_from: Array  # () seconds of the episode from which on touches count


class Tag(Arena):
    """Pucks that chase each other, each a team of its own."""

    exchangeable = True

    def __init__(self, settings: TagSettings, **options: Unpack[EngineOptions]):
        rules = settings.rules
        robot = puck(KIND, rules.radius, 1.0, rules.thrust, rules.thrust / rules.speed, isotropic=True)
        super().__init__(
            settings.name, dict.fromkeys(TEAMS[: settings.teams], (robot,)), settings.timing, asdict(rules),
            props=props.square_of_walls(rules.side, HEIGHT), marker_kinds={"it": "circle"},
            solver=Solver(contacts=4 * settings.teams, rows=4 * settings.teams), **options,
        )  # fmt: skip
        self.rules, self.weights, self.number = rules, settings.reward, settings.teams
        at = list(self.scene.agents.values())
        self._xy = np.array([each.qpos for each in at])[:, None] + np.arange(2)
        self._velocity = np.array([each.qvel for each in at])[:, None] + np.arange(2)
        self._rest = jnp.asarray(self.scene.rest, jnp.float32)
        self._steps = round(rules.episode / settings.timing.control_interval)

    def observation_size(self, agent: str) -> int:
        """Return the size of the observation, which is the same for all."""
        return sum(part.size for part in self.observation_parts(agent))

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the observation."""
        return observation.parts(self.number - 1)

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the terms."""
        return Legend(
            score='seconds as "it": the longest time wins, and equal times are a tie',
            rewards={"rank": "", "it": ""},
            shapings={"approach": ""},
            events={"tag": 'it touched "it" and is "it" now', "tagged": 'it was touched and is "it" no more'},
        )

    # Rules -----------------------------------------------------------------------------------------------------------

    def place(self, key: Array) -> tuple[Array, Array, GameState]:
        """Put all at random distances from the middle and equal angles from each other, and draw who is "it".

        Equal distances of two others would leave their order in an observation to their teams' numbers.
        """
        order, turn, far, first = jax.random.split(key, 4)
        places = jax.random.permutation(order, self.number)
        angle = 2 * jnp.pi * (places / self.number + jax.random.uniform(turn))
        radius = self.rules.side * jax.random.uniform(far, (self.number, 1), minval=START[0], maxval=START[1])
        xy = radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
        it = jax.random.randint(first, (), 0, self.number, jnp.int32)
        game = GameState(it, jnp.zeros(self.number, jnp.int32), jnp.float32(self.rules.immunity))
        return self._rest.at[self._xy].set(xy), jnp.zeros(self.scene.model.nv), game

    def exchange(
        self, qpos: Array, qvel: Array, game: GameState, order: Sequence[int] = (1, 0)
    ) -> tuple[Array, Array, GameState]:
        """Put the pucks in each other's places, with who is "it" and for how long each was."""
        qpos, qvel, _ = super().exchange(qpos, qvel, game, order)
        from_team = jnp.array(order)
        return qpos, qvel, game._replace(it=jnp.argmax(from_team == game.it), held=game.held[from_team])

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Count the step for the puck that is "it"; the nearest one that touches it is "it" next."""
        rules, w, teams = self.rules, self.weights, jnp.arange(self.number)
        is_it = teams == game.it
        was, now = self._gaps(before, game.it), self._gaps(physics, game.it)
        touches = now.min() <= 2 * rules.radius + rules.reach
        tags = touches & (physics.time >= game.counts_from - self.timing.control_interval / 2)
        next_it = jnp.argmin(now).astype(jnp.int32)
        held = game.held + is_it
        over = physics.time > rules.episode - self.timing.control_interval / 2
        score = held * jnp.float32(self.timing.control_interval)
        ahead = 2 * mean_pairwise_score(score) - 1
        due = jnp.where(is_it, 1.0, -1 / (self.number - 1)) * self.timing.control_interval
        gained = jnp.where(is_it, now.min() - was.min(), jnp.where(is_it, 0.0, was - now))
        after = GameState(
            jnp.where(tags, next_it, game.it), held,
            jnp.where(tags, physics.time + rules.immunity, game.counts_from),
        )  # fmt: skip
        return after, Verdict(
            rewards={"rank": w.rank * over * ahead, "it": w.it * due},
            shapings={"approach": w.approach * gained},
            score=score,
            terminated=over,
            truncated=jnp.zeros((), bool),
            events={"tag": tags & (teams == next_it), "tagged": tags & is_it},
        )

    def _gaps(self, physics: Physics, it: Array) -> Array:
        """Return distances in metres from the middle of "it" to that of each puck, (teams,); infinite to itself."""
        xy = physics.qpos[self._xy]
        gaps = jnp.sqrt(jnp.sum((xy - xy[it]) ** 2, axis=-1))
        return jnp.where(jnp.arange(self.number) == it, jnp.inf, gaps)

    # Observations, scripts and markers -------------------------------------------------------------------------------

    def observe(self, physics: Physics, game: GameState, actions: dict[str, Array]) -> dict[str, Array]:
        """Return the observations of `arenas/games/tag/observation.py`."""
        xy, velocity = physics.qpos[self._xy], physics.qvel[self._velocity]
        left = jnp.maximum(0.0, game.counts_from - physics.time) / max(self.rules.immunity, 1e-6)
        held, time = game.held / self._steps, physics.time / self.rules.episode
        return {
            agent: observation.observe(i, xy, velocity, game.it, held, left, time)
            for i, agent in enumerate(self.robots)
        }

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return the scripts of `arenas/games/tag/scripts.py`."""
        return scripts.of_game(self.rules)

    def markers(self, physics: Physics, game: GameState) -> dict[str, Array]:
        """Return a circle round "it", which is wide as long as no touch counts."""
        x, y = physics.qpos[self._xy][game.it]
        immune = physics.time < game.counts_from
        return {"it": jnp.stack([x, y, self.rules.radius * jnp.where(immune, 2.5, 1.6)])}
