"""Soccer's matches: two teams of robots and a ball on a walled pitch; the first goal wins. Blue plays towards +x.

A goal is scored when the ball's middle is over the goal, a part of the ground before the end wall, however high it is.
No time left is a draw that cuts the match off (`truncated`), for nobody sees the clock; `rules.clock` may make it an
end. A robot higher than `rules.ceiling` has been launched by the physics: that too cuts the match off as a draw.

Events, each of a team: `goal`, `conceded`, `own_goal` (it conceded, and was the last to push the ball), `save` (a shot
at its goal is none any more once its robot has pushed the ball), `touch`, `fall`, `launched`. What a push is and what a
shot, `arenas/soccer/pitch.py` says.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import NamedTuple, Unpack

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.about import Legend, Part
from arenas.arena import Arena
from arenas.options import Where
from arenas.physics import Physics
from arenas.robots.robot import Script
from arenas.soccer import pitch, scripts
from arenas.soccer.pitch import Pitch
from arenas.soccer.rules import CONTROL
from arenas.soccer.settings import SoccerSettings
from arenas.soccer.sight import Sight
from arenas.state import Verdict

DROPPED = {
    "leatherback": 0.30
}  # m, with `defects.dropped`; its ANYmals start partly under the ground, which is not reproduced
SIDES = np.array([1.0, -1.0])  # the goal that each team plays at
CLOSE = 0.8  # m, the scale of the term `ball`


class Game(NamedTuple):
    """What the events need beside the physics."""

    last: Array  # (teams,) bool: who pushed the ball last; both, where that cannot be told; at first nobody


class Soccer(Arena):
    """Blue against red."""

    def __init__(self, settings: SoccerSettings, **where: Unpack[Where]):
        rules, sides = settings.rules, {"blue": settings.blue, "red": settings.red}
        super().__init__(
            settings.name, {team: [pitch.robot(kind, rules) for kind in kinds] for team, kinds in sides.items()},
            settings.timing, asdict(rules) | {"randomisation": asdict(settings.randomisation)},
            props=pitch.things(rules), solver=pitch.solver(settings.blue + settings.red), **where,
        )  # fmt: skip
        self.rules, self.weights, self.randomisation = rules, settings.reward, settings.randomisation
        self.randomisation.check(self.scene)
        self.pitch = Pitch(self.scene, self.robots, rules, DROPPED if rules.defects.dropped else {})
        names, blue = list(self.robots), len(settings.blue)
        self._sides = slice(0, blue), slice(blue, len(names))
        self._sight = Sight(self.robots, [names[side] for side in self._sides], rules.goal_at, settings.buffer)
        self._attacks = {name: jnp.asarray(SIDES[int(i >= blue)], jnp.float32) for i, name in enumerate(names)}
        self._targets = jnp.asarray(SIDES, jnp.float32)

    def observation_size(self, agent: str) -> int:
        """66 numbers of an ANYmal, 24 of a rover, and the tail."""
        return self._sight.size(agent)

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """The seven vectors, and who follows."""
        return self._sight.parts(agent)

    def legend(self) -> Legend:
        """Each weight says what its term is."""
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
                "goal": "the ball is in the goal that the team plays at",
                "conceded": "the ball is in the team's own goal",
                "own_goal": "it is, and a robot of the team was the last to push it",
                "save": "a push by the team's robot has turned away a ball that would have rolled into its goal",
                "touch": "a robot of the team has pushed the ball",
                "fall": "a robot of the team has fallen",
                "launched": f"a robot of the team is over {self.rules.ceiling:g} m high: the match is cut off, a draw",
            },
        )

    # Rules -----------------------------------------------------------------------------------------------------------

    def place(self, key: Array) -> tuple[Array, Array, Game]:
        """Robots and ball anywhere on the pitch but in the goals, clear of each other; the ball lies still."""
        return *self.pitch.start(key), Game(jnp.zeros(2, bool))

    def randomise(self, key: Array) -> dict[str, Array]:
        """As the settings say."""
        return self.randomisation.draw(key, self.scene)

    def exchange(self, qpos: Array, qvel: Array, game: Game) -> tuple[Array, Array, Game]:
        """The teams play in opposite directions: all, the ball too, is turned half round about the pitch's centre."""
        qpos, qvel, _ = super().exchange(qpos, qvel, game)
        for at, speed in self._free():
            x, y, z, w, i, j, k = qpos[at : at + 7]
            # Half a turn about z is the quaternion (0, 0, 0, 1), multiplied from the left.
            qpos = qpos.at[at : at + 7].set(jnp.stack([-x, -y, z, -k, -j, i, w]))
            qvel = qvel.at[speed : speed + 2].multiply(-1.0)  # linear in the world's frame; spin is in the body's own
        return qpos, qvel, Game(game.last[::-1])

    def judge(self, before: Physics, physics: Physics, game: Game) -> tuple[Game, Verdict]:
        """The first goal wins; a fall costs what the rules say; no time left is a draw."""
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
        return Game(last), Verdict(
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
        """(teams,) bool: whether that holds of any robot of a team."""
        return jnp.stack([robots[side].any() for side in self._sides])

    def _nearest(self, metres: Array) -> Array:
        """(teams,) the least of a team's robots'."""
        return jnp.stack([metres[side].min() for side in self._sides])

    def _free(self) -> list[tuple[int, int]]:
        """Where the poses and velocities of all that can move begin."""
        robots = [(at.qpos, at.qvel) for at in self.scene.agents.values()]
        return [*robots, (self.pitch.ball_qpos, self.pitch.ball_qvel)]

    # Observations and scripts ----------------------------------------------------------------------------------------

    def observe(self, physics: Physics, game: Game, actions: dict[str, Array]) -> dict[str, Array]:
        """The seven vectors, and who follows."""
        bodies = {agent: self.body(agent, physics, actions) for agent in self.robots}
        return self._sight.observe(bodies, self.pitch.ball(physics), self._attacks)

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """One that scores, one that keeps the goal, one that runs at the ball."""
        return scripts.of_soccer({robot.kind for robot in self.robots.values()}, CONTROL, self.rules)
