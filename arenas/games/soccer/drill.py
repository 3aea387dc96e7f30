"""Soccer's stages 1 and 2: a single robot on the pitch gets to the ball, or scores. One team, measured by its success.

The target goal is drawn at random in each episode and observed. Aim "ball": success is to get within `rules.reach` of
the ball; a goal ends that as a failure. Aim "score": success is the ball in the target goal, failure in the other. A
fall ends both as a failure. The end of the time cuts the attempt off (`truncated`): the clock is not observed, so the
learner bootstraps there; the score counts it as a failure. A launched robot also cuts the attempt off.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions
from arenas.description import Legend, Part
from arenas.games.soccer import pitch, scripts
from arenas.games.soccer.observation import ObservationBuilder
from arenas.games.soccer.pitch import Pitch
from arenas.games.soccer.rules import CONTROL
from arenas.games.soccer.stages import DrillSettings
from arenas.physics.engine import Physics
from arenas.robots.robot import Script
from arenas.state import Verdict

PLAYER = "blue/0"
DROPPED = {"anymal": 0.60, "leatherback": 0.50}  # m, with `defects.dropped`
CLOSE = 0.8  # m, the scale of the terms `near` and `ball`
BEHIND = 1.3  # m behind the ball, as seen from the goal: start of a robot in the easiest episode
TRIES = 24  # places drawn for a ball near the robot; the first that is clear of robot and walls is taken


class GameState(NamedTuple):
    """The task of this episode."""

    side: Array  # () 1: the target is the goal at +x; -1: the goal at -x


class Drill(Arena):
    """A robot, called `blue/0`, and a ball."""

    def __init__(self, settings: DrillSettings, **options: Unpack[EngineOptions]):
        rules = settings.rules
        super().__init__(
            settings.name, {"blue": (pitch.robot(settings.robot, rules),)}, settings.timing,
            {**asdict(rules), "randomisation": asdict(settings.randomisation)},
            props=pitch.build_props(rules), solver=pitch.solver((settings.robot,)), **options,
        )  # fmt: skip
        self.rules, self.randomisation, self.weights = rules, settings.randomisation, asdict(settings.reward)
        self.randomisation.check(self.scene)
        self.pitch = Pitch(self.scene, self.robots, (settings.robot,), rules, DROPPED if rules.defects.dropped else {})
        self._observation_builder = ObservationBuilder(self.robots, [[PLAYER]], rules.goal_at, settings.buffer)

    def observation_size(self, agent: str) -> int:
        """Return the size of the observation: 66 numbers of an ANYmal, 24 of a rover, and the buffer."""
        return self._observation_builder.size(agent)

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the seven vectors, of which those of other robots are zeros."""
        return self._observation_builder.parts(agent)

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the terms."""
        rules = self.rules
        at_ball = f"within {rules.reach:g} m of the ball" + (" when the episode ends" if rules.stay else "")
        aim = f"it is {at_ball}" if rules.aim == "ball" else "the ball is in the target goal"
        return Legend(
            score=f"1 when {aim}; 0 when it falls first, the ball is in {self._ending()}, or time is up",
            rewards=dict.fromkeys(("reached", "goal", "wrong", "fall", "time", "near", "ball"), ""),
            shapings=dict.fromkeys(("approach", "push"), ""),
            events={
                "reached": f"it is within {rules.reach:g} m of the ball",
                "goal": "the ball is in the target goal",
                "wrong_goal": "the ball is in the other goal",
                "touch": "it has pushed the ball",
                "fall": "it has fallen",
                "launched": f"it is more than {rules.ceiling:g} m high: the episode is cut off",
            },
        )

    def _ending(self) -> str:
        return "a goal" if self.rules.aim == "ball" else "the other goal"

    # Rules -----------------------------------------------------------------------------------------------------------

    def place(self, key: Array) -> tuple[Array, Array, GameState]:
        """Place robot and ball without overlap, by the rules; draw the target goal."""
        start, coin = jax.random.split(key)
        near = self.pitch.lattice if self.rules.spread is None else self._near
        side = jnp.where(jax.random.bernoulli(coin), 1.0, -1.0)
        return *self.pitch.start(start, lambda key: self._eased(key, side, near(key))), GameState(side)

    def _near(self, key: Array) -> Array:
        """Draw places (2, 2) m of the robot, on the lattice, and of the ball, uniformly in the free square around it.

        If no try is free, the ball lies beside the robot, towards the middle of the pitch.
        """
        assert self.rules.spread is not None
        where, tries = jax.random.split(key)
        robot = self.pitch.lattice(where)[0]
        radius, clear = self.rules.ball.radius, sum(self.pitch.clear)
        offsets = jax.random.uniform(tries, (TRIES, 2), minval=-self.rules.spread, maxval=self.rules.spread)
        beside = jnp.stack([-clear * jnp.where(robot[0] > 0, 1.0, -1.0), jnp.zeros(())])
        balls = robot + jnp.concatenate([offsets, beside[None]])
        x, y = (jnp.abs(balls[:, i]) for i in range(2))
        inside = (x <= self.rules.inside[0] - radius) & (y <= self.rules.inside[1] - radius)
        free = inside & (pitch.length(balls - robot) >= clear) & ~self.pitch.over_goal(balls)
        return jnp.stack([robot, balls[jnp.argmax(free.at[-1].set(True))]])

    def _eased(self, key: Array, side: Array, places: Array) -> Array:
        """Move places (2, 2) m of robot and ball towards the goal on this side, in a share of the episodes.

        There the ball has a random part of its way to the goal left. The robot's offset from the ball is that part of
        its original offset plus the rest directly behind the ball. If the new places are not free, the old ones stay.
        """
        rules, (robot, ball) = self.rules, places
        if not rules.ease:
            return places
        easy, part = jax.random.split(jax.random.fold_in(key, 1))
        left = jax.random.uniform(part)
        front = jnp.stack([side * (rules.goal_at - rules.goal[0]), jnp.zeros_like(side)])
        way = ball - front
        beside = left * (robot - ball) + (1.0 - left) * BEHIND * way / pitch.length(way)
        eased = front + left * way + jnp.stack([beside, jnp.zeros(2)])
        clear = jnp.array(self.pitch.clear)
        inside = (jnp.abs(eased) <= jnp.array(rules.inside) - clear[:, None]).all()
        free = inside & (pitch.length(beside) >= clear.sum()) & ~self.pitch.over_goal(eased[1:])[0]
        return jnp.where(jax.random.bernoulli(easy, rules.ease) & free, eased, places)

    def randomise(self, key: Array) -> dict[str, Array]:
        """Draw model fields by the settings."""
        return self.randomisation.draw(key, self.scene)

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Judge the control step by the rules at the top of this file."""
        rules, side = self.rules, game.side
        reached = self.pitch.to_ball(physics)[0] <= rules.reach
        goal, wrong = self.pitch.scored(physics, side), self.pitch.scored(physics, -side)
        to_ball = rules.aim == "ball"
        won = reached if to_ball else goal
        stops = reached & (not rules.stay) if to_ball else jnp.zeros((), bool)
        fall = self.fallen(physics)[0] & ~(stops | goal)
        launched = self.pitch.launched(physics)[0]
        over = stops | goal | wrong | fall
        late = physics.time > rules.episode - self.timing.control_interval / 2
        terms = self._terms(physics, side, {"reached": stops, "goal": goal, "wrong": wrong, "fall": fall})
        events = {
            "reached": reached, "goal": goal, "wrong_goal": wrong,
            "touch": self.pitch.touched(before, physics)[0], "fall": fall, "launched": launched,
        }  # fmt: skip
        return game, Verdict(
            rewards={name: (self.weights[name] * value)[None] for name, value in terms.items()},
            shapings={name: (self.weights[name] * value)[None] for name, value in self._hints(before, physics, side)},
            score=1.0 * (won & ~fall)[None],
            terminated=over,
            truncated=(late | launched) & ~over,
            events={name: event[None] for name, event in events.items()},
        )

    def _terms(self, physics: Physics, side: Array, once: Mapping[str, Array]) -> dict[str, Array]:
        dt = self.timing.control_interval
        near, ball = self.pitch.to_ball(physics)[0], self.pitch.to_goal(physics, side)
        return {name: 1.0 * happened for name, happened in once.items()} | {
            "time": jnp.ones(()),
            "near": dt * (1.0 - jnp.tanh(near / CLOSE)),
            "ball": dt * (1.0 - jnp.tanh(ball / CLOSE)),
        }

    def _hints(self, before: Physics, physics: Physics, side: Array) -> list[tuple[str, Array]]:
        approach = self.pitch.to_ball(before)[0] - self.pitch.to_ball(physics)[0]
        return [("approach", approach), ("push", self.pitch.to_goal(before, side) - self.pitch.to_goal(physics, side))]

    # Observations and scripts ----------------------------------------------------------------------------------------

    def observe(self, physics: Physics, game: GameState, actions: dict[str, Array]) -> dict[str, Array]:
        """Return the observation of a match without other robots."""
        bodies = {PLAYER: self.body(PLAYER, physics, actions)}
        return self._observation_builder.observe(bodies, self.pitch.ball(physics), {PLAYER: game.side})

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return the scripts of matches."""
        return scripts.of_soccer(self.robots.values(), CONTROL, self.rules)
