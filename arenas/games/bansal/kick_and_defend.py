"""Kick and defend: a kicker must bring a ball into a goal, a keeper must keep it out.

| term of the reward | when                                                       | kicker   | keeper                 |
|--------------------|------------------------------------------------------------|----------|------------------------|
| result             | the ball is over the goal line between the posts           | +result  | -result                |
|                    | the ball is past the line, or comes back, or time is up    | -result  | +result, touch, stand  |
|                    | the keeper is too far from its line: a foul                | 0        | -result                |
| result             | it falls, with `rules.falls_lose`                          | -result  | -result                |
| shaping            | every control step                                         | see `KickAndDefendReward`         |

By default who falls plays on. A ball comes back if it moves away from the goal faster than 1 m/s. Events: `goal`,
`save`, `foul`, `touch`.
"""

from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena_settings import EngineOptions
from arenas.description import Legend, Part
from arenas.games.bansal.body_distance import BodyShape, gap
from arenas.games.bansal.match import Contest, GameState
from arenas.games.bansal.rules import LINE
from arenas.games.bansal.run_to_goal import goal_line
from arenas.games.bansal.settings import KickAndDefendSettings
from arenas.games.bansal.you_shall_not_pass import BOTH, ROLE, RUNNER
from arenas.physics.engine import KINEMATICS, Physics
from arenas.robots.rotations import into_body
from arenas.scene import props
from arenas.state import Verdict

KICKER, KEEPER = RUNNER, 1.0 - RUNNER  # places 0 and 1
BALL_RADIUS, BALL_MASS = 0.15, 0.1  # m, kg
BALL_X, BALL_Y = (-2.0, 1.0), (-4.0, 4.0)  # m, ranges at the start
X = jnp.array([[-3.5, -0.5], [1.6, 3.5]])  # m, of kicker and keeper
Y = (-2.0, 2.0)
CLEAR = 0.8  # m between the middles of kicker and ball at the start, at least
BACK = 1.0  # m/s
BALL_ROWS = 24  # of Warp's buffers: contacts of the ball with ground and bodies


class Shot(NamedTuple):
    """The ball and the start, which the observation and the reward need."""

    ball: Array  # (2,) m, at the start
    touched: Array  # () bool: the keeper has touched the ball


class KickAndDefend(Contest):
    """Kick and defend; the kicker has place 0."""

    def __init__(self, settings: KickAndDefendSettings, **options: Unpack[EngineOptions]):
        super().__init__(
            settings,
            derived=KINEMATICS,
            props=(props.ball(radius=BALL_RADIUS, mass=BALL_MASS),),
            marker_kinds={"goal": "segment", "box": "segment"},
            more_rows=BALL_ROWS,
            **options,
        )
        self.rules = settings.rules
        self._shapes = [BodyShape(self.scene.model, f"{name}/") for name in self.names]
        self._ball_shape = BodyShape(self.scene.model, "ball/")
        self._ball = self.scene.props["ball"]
        assert self._ball.qpos is not None
        assert self._ball.qvel is not None
        self._ball_qpos, self._ball_qvel = self._ball.qpos, self._ball.qvel

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the terms."""
        return Legend(
            score="1 for the kicker if the ball is over the goal line between the posts, or the keeper is more than"
            f" {self.rules.box:g} m from its line; 1 for the keeper if the ball is past the line elsewhere, moves back"
            f" faster than {BACK:g} m/s, or time is up"
            + ("; 1 for the other if one falls, ½ each if both do" if self.rules.falls_lose else ""),
            rewards=dict.fromkeys(("result", "touch", "stand"), ""),
            shapings=dict.fromkeys(("forward", "approach", "ball", "control", "alive"), ""),
            events={
                "goal": "it kicks, and the ball is in the goal", "save": "it keeps, and the ball is out or comes back",
                "foul": "it keeps, and is too far from its line", "touch": "it keeps, and touches the ball",
            },
        )  # fmt: skip

    def draw(self, key: Array) -> tuple[Array, Shot]:
        """Draw kicker, keeper and ball in their ranges, the ball clear of the kicker."""
        keys = jax.random.split(key, 3)
        most, least = self.rules.spread, self.rules.least_spread
        spread = most if least is None else jax.random.uniform(jax.random.fold_in(key, 3), minval=least, maxval=most)
        x = _within(keys[0], X[:, 0], X[:, 1], spread, (2,))
        y = _within(keys[1], *Y, spread, (2,))
        low, high = jnp.array([BALL_X[0], BALL_Y[0]]), jnp.array([BALL_X[1], BALL_Y[1]])
        ball = _within(keys[2], low, high, spread, (2,))
        xy = jnp.stack([x, y], axis=1)
        off = ball - xy[0]
        far = jnp.maximum(jnp.sqrt(jnp.sum(off**2)), 1e-3)
        return xy, Shot(xy[0] + off * jnp.maximum(1.0, CLEAR / far), jnp.zeros((), bool))

    def set_props(self, qpos: Array, own: Shot) -> Array:
        """Return qpos with the ball at its start."""
        return qpos.at[self._ball_qpos : self._ball_qpos + 2].set(own.ball)

    def extra_parts(self) -> tuple[Part, ...]:
        """Describe the role and the ball."""
        return (
            Part("role", 1, "", "1: kicker, -1: keeper"),
            Part("ball", 3, "m", "from its own base, in its own frame"),
            Part("ball velocity", 3, "m/s", "in its own frame"),
        )

    def extra(self, physics: Physics, game: GameState) -> Array:
        """Return the role and the ball."""
        at, velocity = self._ball_motion(physics)
        quats = jnp.stack([physics.qpos[i.qpos + 3 : i.qpos + 7] for i in self.bodies_at])
        quats, xyz = self.by_team(quats, game.second_first), self.places(physics, game).xyz
        seen = [jnp.concatenate([into_body(quats[i], at - xyz[i]), into_body(quats[i], velocity)]) for i in (0, 1)]
        return jnp.concatenate([ROLE, jnp.stack(seen)], axis=1)

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Judge the ball, the keeper's place and the end of the time."""
        was, now = self.places(before, game), self.places(physics, game)
        ball, velocity = self._ball_motion(physics)
        touch = self._keeper_touches(physics, game)
        shot: Shot = game.own._replace(touched=game.own.touched | touch)
        goal = (ball[0] > LINE) & (jnp.abs(ball[1]) <= self.rules.mouth)
        foul = ~goal & (now.xyz[1, 0] < LINE - self.rules.box)
        back = (velocity[0] < 0.0) & (jnp.sqrt(jnp.sum(velocity**2)) > BACK)
        saved = ~goal & ~foul & ((ball[0] > LINE) | back | self.late(physics))
        stands = now.xyz[:, 2] > self.rules.fall_height
        fell = self.rules.falls_lose & ~(goal | foul | saved) & ~stands
        w, bonus = self.weights, saved * KEEPER
        rewards = {
            "result": w["result"] * (goal * BOTH - saved * BOTH - foul * KEEPER - fell),
            "touch": w["touch"] * shot.touched * bonus,
            "stand": w["stand"] * stands[1] * bonus,
        }
        dt, gap_xy = self.timing.control_interval, ball[:2] - now.xyz[0, :2]
        before_goal = jnp.abs(now.xyz[1, 1]) <= self.rules.mouth
        common = self.common_terms(game, now.xyz[:, 2])
        shapings = {
            "forward": (now.xyz[0, 0] - was.xyz[0, 0]) * KICKER,
            "approach": dt * jnp.sqrt(jnp.sum(gap_xy**2)) * KICKER,
            "ball": dt * jnp.abs(ball[0] - LINE) * BOTH,
            "control": common["control"],
            "alive": common["alive"] * jnp.where(before_goal, 1.0, KICKER),
        }
        after_falls = jnp.where(jnp.all(fell), 0.5, fell[::-1] * 1.0)  # of whom the other's fall lets win
        score = jnp.where(goal | foul, KICKER, jnp.where(saved, KEEPER, after_falls))
        flags = {"goal": goal & (KICKER > 0), "save": saved & (KEEPER > 0), "foul": foul & (KEEPER > 0)}
        events = {**flags, "touch": touch & (KEEPER > 0)}
        game = game._replace(own=shot)
        return game, self.verdict(game, rewards, shapings, score, goal | foul | saved | jnp.any(fell), events)

    def markers(self, physics: Physics, game: GameState) -> dict[str, Array]:
        """Return the goal line between the posts, and the edge of the keeper's box."""
        return {"goal": goal_line(LINE, self.rules.mouth), "box": goal_line(LINE - self.rules.box, self.rules.mouth)}

    def _ball_motion(self, physics: Physics) -> tuple[Array, Array]:
        """Return the ball's place (3,) m and velocity (3,) m/s."""
        return (
            physics.qpos[self._ball_qpos : self._ball_qpos + 3],
            physics.qvel[self._ball_qvel : self._ball_qvel + 3],
        )

    def _keeper_touches(self, physics: Physics, game: GameState) -> Array:
        """Return () bool: the keeper is as near to the ball as a touch."""
        assert physics.xpos is not None
        assert physics.xquat is not None
        ball = self._ball_shape.segments(physics.xpos, physics.xquat)
        gaps = jnp.stack([gap(shape.segments(physics.xpos, physics.xquat), ball) for shape in self._shapes])
        return self.by_team(gaps, game.second_first)[1] <= self.rules.touch


def _within(
    key: Array, low: Array | float, high: Array | float, spread: Array | float, shape: tuple[int, ...]
) -> Array:  # fmt: skip
    """Draw uniformly in a share `spread` of the range, around its middle."""
    middle, half = (jnp.asarray(low) + high) / 2, (jnp.asarray(high) - low) / 2
    return middle + spread * half * jax.random.uniform(key, shape, minval=-1.0)
