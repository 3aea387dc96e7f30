"""Soccer's matches: two teams of robots and a ball on a walled pitch; the first goal wins. Blue plays towards +x.

A goal is scored when the ball's middle is over the goal, a part of the ground before the end wall, at any height. The
end of the time is a draw that cuts the match off (`truncated`), because the clock is not observed; `rules.clock` can
make it terminal. A robot higher than `rules.ceiling` has been launched by the physics: that also cuts the match off as
a draw.

Events, each of a team: `goal`, `conceded`, `own_goal` (it conceded, and was the last to push the ball), `save` (its
robot pushed the ball, which ended a shot at its goal), `touch`, `fall`, `launched`. `arenas/games/soccer/pitch.py`
defines a push and a shot.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import NamedTuple, Unpack

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions
from arenas.description import Legend, Part
from arenas.games.soccer import pitch, scripts
from arenas.games.soccer.observation import ObservationBuilder
from arenas.games.soccer.pitch import Pitch
from arenas.games.soccer.rules import CONTROL
from arenas.games.soccer.settings import SoccerSettings
from arenas.physics.engine import Physics
from arenas.robots.robot import Script
from arenas.state import Verdict

DROPPED = {
    "leatherback": 0.30
}  # m, with `defects.dropped`; HARL-A's ANYmals start partly under the ground, which is not reproduced
SIDES = np.array([1.0, -1.0])  # side of the goal that each team attacks
CLOSE = 0.8  # m, the scale of the term `ball`


class GameState(NamedTuple):
    """State that the events need besides the physics."""

    last: Array  # (teams,) bool: the team that pushed the ball last; both if unclear; none at first


class Soccer(Arena):
    """Blue against red."""

    exchangeable = True

    def __init__(self, settings: SoccerSettings, **options: Unpack[EngineOptions]):
        rules, sides = settings.rules, {"blue": settings.blue, "red": settings.red}
        super().__init__(
            settings.name, {team: [pitch.robot(kind, rules) for kind in kinds] for team, kinds in sides.items()},
            settings.timing, asdict(rules) | {"randomisation": asdict(settings.randomisation)},
            props=pitch.build_props(rules), solver=pitch.solver(settings.blue + settings.red), **options,
        )  # fmt: skip
        self.rules, self.weights, self.randomisation = rules, settings.reward, settings.randomisation
        self.randomisation.check(self.scene)
        self.pitch = Pitch(
            self.scene, self.robots, settings.blue + settings.red, rules, DROPPED if rules.defects.dropped else {}
        )
        names, blue = list(self.robots), len(settings.blue)
        self._sides = slice(0, blue), slice(blue, len(names))
        self._observation_builder = ObservationBuilder(
            self.robots, [names[side] for side in self._sides], rules.goal_at, settings.buffer
        )
        self._attacks = {name: jnp.asarray(SIDES[int(i >= blue)], jnp.float32) for i, name in enumerate(names)}
        self._targets = jnp.asarray(SIDES, jnp.float32)

    def observation_size(self, agent: str) -> int:
        """Return the size of the observation: 66 numbers of an ANYmal, 24 of a rover, and the tail."""
        return self._observation_builder.size(agent)

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the seven vectors and the tail."""
        return self._observation_builder.parts(agent)

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the terms."""
        falls = {
            "play": "",
            "lose": "; a fall loses the match", "end": "; a fall ends the match as a draw",
        }[self.rules.falls]  # fmt: skip
        clock = " and cuts the match off" if self.rules.clock == "cut" else ""
        return Legend(
            score="1 for the team that scores first, 0 for the other; ½ each when time is up, which is a draw"
            f"{clock}{falls}",
            rewards=dict.fromkeys(("goal", "concede", "time"), ""),
            shapings=dict.fromkeys(("ball", "approach", "push"), ""),
            events={
                "goal": "the ball is in the goal that the team attacks",
                "conceded": "the ball is in the team's own goal",
                "own_goal": "the ball is in the team's own goal, and a robot of the team pushed it last",
                "save": "a push by the team's robot has turned away a ball that would have rolled into its goal",
                "touch": "a robot of the team has pushed the ball",
                "fall": "a robot of the team has fallen",
                "launched": f"a robot of the team is over {self.rules.ceiling:g} m high: the match is cut off, a draw",
            },
        )

    # Rules -----------------------------------------------------------------------------------------------------------

    def place(self, key: Array) -> tuple[Array, Array, GameState]:
        """Place robots and ball anywhere on the pitch except in the goals, without overlap and at rest."""
        return *self.pitch.start(key), GameState(jnp.zeros(2, bool))

    def randomise(self, key: Array) -> dict[str, Array]:
        """Draw model fields by the settings."""
        return self.randomisation.draw(key, self.scene)

    def exchange(
        self, qpos: Array, qvel: Array, game: GameState, order: Sequence[int] = (1, 0)
    ) -> tuple[Array, Array, GameState]:
        """Exchange the teams and rotate everything, including the ball, by half a turn about the pitch's centre."""
        qpos, qvel, _ = super().exchange(qpos, qvel, game, order)
        for at, speed in self._free():
            x, y, z, w, i, j, k = qpos[at : at + 7]
            # Half a turn about z is the quaternion (0, 0, 0, 1), multiplied from the left.
            qpos = qpos.at[at : at + 7].set(jnp.stack([-x, -y, z, -k, -j, i, w]))
            qvel = qvel.at[speed : speed + 2].multiply(-1.0)  # linear in the world's frame; spin is in the body's own
        return qpos, qvel, GameState(game.last[jnp.array(order)])

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Judge the control step: the first goal wins, falls count by the rules, the end of time is a draw."""
        rules = self.rules
        goal = self.pitch.scored(physics, self._targets)
        fall, launched = self._any(self.fallen(physics)), self._any(self.pitch.launched(physics))
        touch = self._any(self.pitch.touched(before, physics))
        lost = goal[::-1] | fall if rules.falls == "lose" else goal[::-1]
        won, beaten = lost[::-1] & ~lost, lost & ~lost[::-1]
        late = physics.time > rules.episode - self.timing.control_interval / 2
        over = lost.any() | (fall.any() if rules.falls == "end" else False)
        if rules.clock == "end":
            over = over | late
        last = jnp.where(touch.any(), touch, game.last)
        mine = -self._targets
        saved = touch & self.pitch.shot(before, mine) & ~self.pitch.shot(physics, mine) & ~goal[::-1]
        w = self.weights
        return GameState(last), Verdict(
            rewards={"goal": w.goal * won, "concede": w.concede * beaten, "time": jnp.full(2, w.time)},
            shapings=self._hints(before, physics),
            score=jnp.where(won.any(), 1.0 * won, 0.5),
            terminated=over,
            truncated=(late | launched.any()) & ~over,
            events={
                "goal": goal, "conceded": goal[::-1], "own_goal": goal[::-1] & last & ~last[::-1], "save": saved,
                "touch": touch, "fall": fall, "launched": launched,
            },
        )  # fmt: skip

    def _hints(self, before: Physics, physics: Physics) -> dict[str, Array]:
        w, far = self.weights, self.pitch.to_goal
        paid = 1.0 if w.defects.per_step else self.timing.control_interval
        goals = jnp.full(2, -1.0) if w.defects.own_goal else self._targets
        was, now = (self._nearest(self.pitch.to_ball(each)) for each in (before, physics))
        return {
            "ball": w.ball * paid * (1.0 - jnp.tanh(far(physics, goals) / CLOSE)),
            "approach": w.approach * (was - now),
            "push": w.push * (far(before, self._targets) - far(physics, self._targets)),
        }

    def _any(self, robots: Array) -> Array:
        """Return (teams,) bool: any robot of the team is true."""
        return jnp.stack([robots[side].any() for side in self._sides])

    def _nearest(self, metres: Array) -> Array:
        """Return (teams,) the minimum over a team's robots."""
        return jnp.stack([metres[side].min() for side in self._sides])

    def _free(self) -> list[tuple[int, int]]:
        """Return the indices in qpos and qvel of everything that can move."""
        robots = [(at.qpos, at.qvel) for at in self.scene.agents.values()]
        return [*robots, (self.pitch.ball_qpos, self.pitch.ball_qvel)]

    # Observations and scripts ----------------------------------------------------------------------------------------

    def observe(self, physics: Physics, game: GameState, actions: dict[str, Array]) -> dict[str, Array]:
        """Return the seven vectors and the tail of each agent."""
        bodies = {agent: self.body(agent, physics, actions) for agent in self.robots}
        return self._observation_builder.observe(bodies, self.pitch.ball(physics), self._attacks)

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return a striker, a keeper and a robot that chases the ball."""
        return scripts.of_soccer(self.robots.values(), CONTROL, self.rules)
