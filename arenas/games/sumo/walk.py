"""Sumo, stage 1: an ANYmal walks to a point on an open plane. One team of one robot, measured by its success.

It succeeds when it is within reach of the goal, and fails when it falls: its torso touches the ground, or it lies on
its side. The end of the time cuts the attempt off (`truncated`): the clock is no part of the task and not observed, so
the learner bootstraps there; the score counts it as a failure.

The observation has HARL-A's slots (`arenas/games/sumo/paper_observation.py`): A is the goal, 0.25 m above the ground,
all else is zero. For later stages with another layout, the walk accepts another `WalkObservation` (soccer's is in
`arenas/games/soccer/observation.py`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple, Unpack

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions, Solver
from arenas.description import Legend, Part
from arenas.games.sumo import paper_observation, scripts
from arenas.games.sumo.clearance import clearance
from arenas.games.sumo.stages import WalkSettings
from arenas.games.terms import weights_of
from arenas.physics.engine import Physics
from arenas.robots.anymal import anymal
from arenas.robots.kinematics import Heights
from arenas.robots.robot import Body, Robot, Script
from arenas.robots.rotations import into_body, up_z
from arenas.scene.props import Prop
from arenas.state import Verdict

WALKER = "blue/0"
CONTROL = 0.02  # s
TROT = -0.5  # speed command of the seeker to its gait, see `scripts.Pace`
GOAL_HEIGHT = 0.25  # m, as in HARL-A
SPREAD = 0.5  # m/s and rad/s: a velocity error of this size leaves 1/e of its term
TURN_RATE = 1.0  # rad/s, the fastest turn of the target; proportionally slower when it faces the goal within 1 rad
FAR = 5.0  # m, the scale of the term `distance`
STEP_TIME = 0.5  # s, the desired time of a foot in the air


class GameState(NamedTuple):
    """State that this episode's reward needs besides the physics."""

    goal: Array  # (2,) m, in the world
    action: Array  # (action_size,) the present action
    last: Array  # (action_size,) the previous action
    air: Array  # (feet,) s since each foot left the ground, 0 while it is on it
    nature: Any = ()  # of games in which nature disturbs the walk


class WalkObservation(NamedTuple):
    """Layout of a walker's observation: that of later stages, with the goal in one of its vectors."""

    size: int  # numbers in it
    at: int  # index of the goal's position (3,), m in the robot's frame
    fill: Callable[[Robot, Body, Array], Array]  # robot, body, that position -> observation (size,)
    parts: Callable[[Robot, str], tuple[Part, ...]]  # robot, description of the goal -> description of the observation


def sumo_walk_observation(buffer: int) -> WalkObservation:
    """Return HARL-A's slots of sumo, with the goal in slot A."""
    none, nowhere = jnp.zeros(3), jnp.zeros(())
    return WalkObservation(
        paper_observation.size("anymal", 0, buffer),
        paper_observation.first_index("anymal", "a"),
        lambda robot, body, goal: paper_observation.fill(
            robot, body, goal, none, none, nowhere, nowhere, buffer=buffer
        ),
        lambda robot, goal: paper_observation.slot_parts(
            robot.kind, robot.sensed_parts, (goal, "", ""), buffer, ring=False
        ),
    )


class Walk(Arena):
    """An ANYmal, called `blue/0`, and its goal; `layout` is its observation, by default as in sumo's later stages.

    `others` are rosters of further teams, whose games judge them, and `props` what else is in the scene.
    """

    def __init__(
        self,
        settings: WalkSettings,
        layout: WalkObservation | None = None,
        robot: Robot | None = None,
        solver: Solver | None = None,
        others: Mapping[str, Sequence[Robot]] | None = None,
        props: Sequence[Prop] = (),
        **options: Unpack[EngineOptions],
    ):
        rules = settings.rules
        self.layout = layout or sumo_walk_observation(settings.buffer)
        self.robot = robot or anymal()
        # Random play, including falls, had at most 7 contacts and 29 rows; twelve joints may be at their limits.
        super().__init__(
            settings.name, {"blue": (self.robot,), **(others or {})}, settings.timing,
            {**asdict(rules), "randomisation": asdict(settings.randomisation)},
            props=props, solver=solver or Solver(contacts=18, rows=80), marker_kinds={"goal": "circle"}, **options,
        )  # fmt: skip
        self.rules, self.randomisation = rules, settings.randomisation
        self.weights = weights_of(settings.reward)
        self.speed = self.weights.pop("speed")
        self.randomisation.check(self.scene)
        self._at = self.scene.agents[WALKER]
        self._rest = jnp.asarray(self.scene.rest, jnp.float32)

    def observation_size(self, agent: str) -> int:
        """Return the size of the observation: in sumo's slots 56 numbers and the buffer."""
        return self.layout.size

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the observation: in sumo's slots only one is filled."""
        return self.layout.parts(self.robot, f"goal, {GOAL_HEIGHT:g} m above the ground")

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the terms."""
        return Legend(
            score=f"1 when it is within {self.rules.reach:g} m of the goal; 0 when it falls first, or time is up",
            rewards=dict.fromkeys(self.weights, ""),
            events={"reached": "it is at the goal", "fall": "its torso touches the ground, or it lies on its side"},
        )

    def place(self, key: Array) -> tuple[Array, Array, GameState]:
        """Place the robot at the origin and the goal anywhere in the square, possibly within reach."""
        turn, where = jax.random.split(key)
        random = self.rules.heading == "random"
        heading = jax.random.uniform(turn, maxval=2 * jnp.pi) if random else jnp.asarray(jnp.pi / 2)
        zero = jnp.zeros(())
        at = self._at.qpos + 3
        quat = jnp.stack([jnp.cos(heading / 2), zero, zero, jnp.sin(heading / 2)])
        goal = jax.random.uniform(where, (2,), minval=-self.rules.goal, maxval=self.rules.goal)
        still = jnp.zeros(self.robot.action_size)
        qpos = self._rest.at[at : at + 4].set(quat)
        return qpos, jnp.zeros(self.scene.model.nv), GameState(goal, still, still, jnp.zeros(len(self.robot.feet)))

    def randomise(self, key: Array) -> dict[str, Array]:
        """Draw model fields by the settings."""
        return self.randomisation.draw(key, self.scene)

    def decide(self, game: GameState, actions: dict[str, Array]) -> GameState:
        """Store the new action and the previous one."""
        return game._replace(action=actions[WALKER], last=game.action)

    def observe(self, physics: Physics, game: GameState, actions: dict[str, Array]) -> dict[str, Array]:
        """Return proprioception and the goal."""
        body = self.body(WALKER, physics, actions)
        return {WALKER: self.layout.fill(self.robot, body, self._goal_in_base_frame(body, game))}

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Judge the control step: arrival is success, a fall or the end of time a failure."""
        body = self.body(WALKER, physics, {WALKER: game.action})
        low = self.heights(physics, body)
        reached = self._distance(physics, game) <= self.rules.reach
        fall = ~reached & self.down(physics, body, low)
        late = physics.time > self.rules.episode - self.timing.control_interval / 2
        terms = self._once(before, physics, game, reached, fall) | self._per_second(before, physics, game, body, low)
        game = game._replace(air=jnp.where(low.feet <= 0.0, 0.0, game.air + self.timing.control_interval))
        return game, Verdict(
            rewards={name: weight * terms[name][None] for name, weight in self.weights.items()},
            shapings={},
            score=1.0 * reached[None],
            terminated=reached | fall,
            truncated=late & ~reached & ~fall,
            events={"reached": reached[None], "fall": fall[None]},
        )

    def heights(self, physics: Physics, body: Body) -> Heights:
        """Return the heights of torso, thighs and feet."""
        return clearance(body.pose, body.angles)

    def down(self, physics: Physics, body: Body, low: Heights) -> Array:
        """Return () bool: it has fallen."""
        return (low.torso <= 0.0) | (up_z(body.pose[3:]) < self.rules.fall_up)

    def markers(self, physics: Physics, game: GameState) -> dict[str, Array]:
        """Return the circle that counts as reached."""
        return {"goal": jnp.append(game.goal, self.rules.reach)}

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return a script that trots an ANYmal towards the goal, the only position in its slots; there is no edge."""
        at = self.layout.at
        view = scripts.View(
            lambda seen: seen[at : at + 3][None], lambda seen: jnp.zeros(()), lambda seen: jnp.asarray(jnp.inf), None
        )
        if self.robot.kind != "anymal":
            return {}
        return {"seeker": {"anymal": scripts.pusher("anymal", view, scripts.Pace(CONTROL, trot=TROT))}}

    # Terms -----------------------------------------------------------------------------------------------------------

    def _once(
        self, before: Physics, physics: Physics, game: GameState, reached: Array, fall: Array
    ) -> dict[str, Array]:
        gained = self._distance(before, game) - self._distance(physics, game)
        return {"reached": 1.0 * reached, "fall": 1.0 * fall, "progress": gained}

    def _per_second(
        self, before: Physics, physics: Physics, game: GameState, body: Body, low: Heights
    ) -> dict[str, Array]:
        """Return the terms that are paid by time, for one control step.

        The torques are those of the last substep, as applied. HARL-A also takes accelerations over the last substep.
        Here they are changes of speed over the whole control step, which leaves out oscillations faster than 50 Hz.
        """
        dt, quat = self.timing.control_interval, body.pose[3:]
        seen = self._goal_in_base_frame(body, game)
        velocity, rates = into_body(quat, body.velocity[:3]), body.velocity[3:]
        wanted = self.speed * seen[:2] / jnp.maximum(jnp.sqrt(jnp.sum(seen[:2] ** 2)), 1e-6)
        turn = jnp.clip(jnp.arctan2(seen[1], seen[0]), -TURN_RATE, TURN_RATE)
        gained = body.speeds - self.body(WALKER, before, {WALKER: game.action}).speeds
        landed = (low.feet <= 0.0) & (game.air > 0.0)
        down = into_body(quat, jnp.array([0.0, 0.0, -1.0]))
        per_second = {
            "tracking": jnp.exp(-jnp.sum((velocity[:2] - wanted) ** 2) / SPREAD**2),
            "turning": jnp.exp(-((rates[2] - turn) ** 2) / SPREAD**2),
            "distance": 1.0 - jnp.tanh(self._distance(physics, game) / FAR),
            "vertical": velocity[2] ** 2,
            "roll_pitch": jnp.sum(rates[:2] ** 2),
            "torque": jnp.sum(self._torques(physics, body) ** 2),
            "acceleration": jnp.sum((gained / dt) ** 2),
            "action_change": jnp.sum((game.action - game.last) ** 2),
            "air_time": jnp.sum((game.air - STEP_TIME) * landed),
            "thigh_contact": jnp.sum(1.0 * (low.limbs <= 0.0)),
            "tilt": jnp.sum(down[:2] ** 2),
        }
        return {name: dt * value for name, value in per_second.items()}

    def _torques(self, physics: Physics, body: Body) -> Array:
        """Return the motors' torques (actuators,) in the last substep, N·m."""
        ctrl = physics.ctrl[self._at.ctrl]
        return ctrl if self.robot.torques is None else self.robot.torques(body.angles, body.speeds, ctrl)

    def _distance(self, physics: Physics, game: GameState) -> Array:
        """Return the distance to the goal in metres, along the ground."""
        return jnp.sqrt(jnp.sum((self._at.pose(physics.qpos)[:2] - game.goal) ** 2))

    def _goal_in_base_frame(self, body: Body, game: GameState) -> Array:
        """Return the goal (3,) in the robot's frame."""
        return paper_observation.in_base_frame(body, jnp.append(game.goal, GOAL_HEIGHT))
