"""Sumo: two teams of rovers in a ring; the first team with a robot outside, or on its back, loses.

| reward            | when                                                    | each team                              |
|-------------------|---------------------------------------------------------|----------------------------------------|
| outcome           | one team lost / both in the same control step           | +1 and -1 / 0 and 0                    |
| outcome           | the time is up (a terminal state: the penalty is part of the game) | -timeout_penalty            |
| shaping (dense)   | every control step                                      | see `SumoReward`                       |

Observation of an agent, `11 + 9 × other robots` numbers, in its own heading frame:

| index | what                                    | index      | per other robot: team-mates first, then enemies     |
|-------|-----------------------------------------|------------|-----------------------------------------------------|
| 0-1   | own velocity, m/s                       | +0-1       | relative position, m                                |
| 2     | yaw rate, rad/s                         | +2-3       | unit bearing                                        |
| 3-4   | vector to the ring's centre / radius    | +4-5       | relative heading, cosine and sine                   |
| 5, 6  | own margin to the edge, ring radius, m  | +6-7       | relative velocity, m/s                              |
| 7     | share of the match that has passed      | +8         | its margin to the edge, m                           |
| 8     | up axis, world z                        |            |                                                     |
| 9-10  | last action                             |            |                                                     |

Rules and settings of the quick start: `docs/arenas/sumo.md` says why each is what it is. HARL-A's own sumo decides at
50 Hz, drives at 10·a rad/s and has a ring that stays; two equal rovers then never move each other, so that all matches
between equals end on time. Here the ring may shrink late in a match (sudden death).
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import ClassVar, NamedTuple, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena, Script, Timing, Verdict, Where, up_z, yaw
from arenas.engines import Physics
from arenas.robots.leatherback import leatherback

TEAMS = ("blue", "red")
OWN, PER_OTHER = 11, 9  # numbers in an observation
UPRIGHT = 0.3  # an up axis whose world z is below this is a fall
HULL = 0.59  # m, a rover from corner to corner
NEAREST, FARTHEST = 0.35, 0.75  # where robots start, as shares of the ring's radius
WOBBLE = 0.25  # rad by which a team may stand off the diameter


@dataclass(frozen=True)
class SumoReward:
    """Rewards, which shape learning and never decide a match."""

    timeout_penalty: float = field(default=0.5, metadata={"low": 0.0})
    """Taken from both teams when the time is up."""
    approach: float = 0.2
    """Dense: per metre gained towards the nearest enemy, mean over the team."""
    push: float = 1.0
    """Dense: per metre that enemies moved outwards less what the own robots did, means over the teams."""
    clip: float = field(default=2.0, metadata={"low": 0.0})
    """The dense part stays within ± this, per second."""


@dataclass(frozen=True)
class SumoRules:
    """What decides a match: with the bodies, these make the arena's configuration hash."""

    ring: tuple[float, float] = (1.6, 2.2)
    """Ring radius in metres, drawn uniformly per episode."""
    episode: float = field(default=10.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds until time is up: a draw."""
    shrink_after: float = field(default=5.0, metadata={"low": 0.0})
    """Seconds until the ring starts to shrink (at least `episode`: never)."""
    shrink_to: float = field(default=0.2, metadata={"low": 0.05, "high": 1.0})
    """Share of its radius that the ring has left when time is up. Two rovers fit into 0.3 m and more, and may wait."""
    decide_every: int = field(default=5, metadata={"low": 1, "high": 50})
    """Control steps (50 Hz) for which an action is held: 5 decides at 10 Hz, 1 is the paper's 50 Hz."""
    timestep: float = field(default=0.01, metadata={"low": 0.001, "high": 0.02})
    """Physics timestep in seconds; a control step of 0.02 s must hold a whole number of them."""
    drive_scale: float = field(default=60.0, metadata={"low": 1.0, "high": 100.0})
    """Wheel speed for throttle 1, rad/s: 60 is 3.1 m/s; the paper's is 10."""
    steer_scale: float = field(default=0.6, metadata={"low": 0.01, "high": 0.75})
    """Steering angle for steering 1, rad; the paper's is 0.1."""

    def __post_init__(self) -> None:
        """Check what depends on two fields or on their order."""
        if not 0.5 <= self.ring[0] <= self.ring[1] <= 20.0:
            raise ValueError(f"ring: {list(self.ring)} must be two radii in metres, 0.5 <= smallest <= largest <= 20")
        steps = 0.02 / self.timestep
        if abs(steps - round(steps)) > 1e-6:
            raise ValueError(
                f"timestep: 0.02 s is no whole number of {self.timestep} s; use 0.02, 0.01, 0.005 or 0.004"
            )


class Game(NamedTuple):
    """The ring of this episode."""

    radius: Array  # () m at the start


class Pose(NamedTuple):
    """Planar facts of all robots, read from qpos and qvel: nothing here lags behind."""

    xy: Array  # (robots, 2) m
    heading: Array  # (robots,) rad
    velocity: Array  # (robots, 2) m/s, world frame
    yaw_rate: Array  # (robots,) rad/s
    up: Array  # (robots,)


@dataclass(frozen=True)
class SumoSettings:
    """A sumo arena: how many rovers, by which rules, and what learning is told."""

    name: str = "sumo-2v2"
    """The arena's name."""
    team_size: int = field(default=2, metadata={"low": 1, "high": 4})
    """Rovers in each team."""
    rules: SumoRules = field(default_factory=SumoRules)
    """What decides a match."""
    reward: SumoReward = field(default_factory=SumoReward)
    """What shapes learning."""

    def __post_init__(self) -> None:
        """Check that all robots find room on the innermost circle."""
        angle = _pitch(self.team_size) if self.team_size > 1 else math.pi - 2 * WOBBLE
        smallest = HULL / (2 * NEAREST * math.sin(angle / 2))
        if self.rules.ring[0] < smallest:
            raise ValueError(
                f"team_size: rovers could start inside each other in a ring of {self.rules.ring[0]} m;"
                f" rules.ring must begin at {math.ceil(100 * smallest) / 100} m or more"
            )

    def build(self, **where: Unpack[Where]) -> "Sumo":
        """The arena itself."""
        return Sumo(self, **where)


class Sumo(Arena):
    """`team_size` rovers against as many, blue against red."""

    marker_kinds: ClassVar[Mapping[str, str]] = {"ring": "circle"}

    def __init__(self, settings: SumoSettings, **where: Unpack[Where]):
        rules = settings.rules
        self.team_size, self.rules, self.weights = settings.team_size, rules, settings.reward
        rover = leatherback(rules.drive_scale, rules.steer_scale)
        timing = Timing(rules.timestep, round(0.02 / rules.timestep), rules.decide_every, rules.episode)
        # Sized from play: four tyres and a hull with 8 corners on hulls beside it, four rows for each contact.
        self.contacts = 12 * 2 * settings.team_size
        self.rows = 4 * self.contacts
        rosters = {team: (rover,) * settings.team_size for team in TEAMS}
        super().__init__(settings.name, rosters, timing, asdict(rules), **where)
        index = [self.scene.agents[a.name] for a in self.agents]
        self._qpos = np.array([i.qpos for i in index])[:, None] + np.arange(7)
        self._qvel = np.array([i.qvel for i in index])[:, None] + np.arange(6)
        self._rest = jnp.asarray(self.scene.model.qpos0, jnp.float32)
        self._order = _listing(settings.team_size)

    def observation_size(self, agent: str) -> int:
        """Numbers in an observation: own part and one part for every other robot."""
        return OWN + PER_OTHER * (2 * self.team_size - 1)

    # Rules -----------------------------------------------------------------------------------------------------------

    def ring_radius(self, game: Game, time: Array) -> Array:
        """Radius in metres now: constant, then falling linearly until time is up."""
        r = self.rules
        if r.shrink_after >= r.episode:
            return game.radius
        late = jnp.clip((time - r.shrink_after) / (r.episode - r.shrink_after), 0.0, 1.0)
        return game.radius * (1.0 - (1.0 - r.shrink_to) * late)

    def place(self, key: Array) -> tuple[Array, Array, Game]:
        """Teams on opposite sides of a random diameter, each robot with its own distance and its own heading.

        Even on the innermost circle their hulls are clear of each other: the settings see to that. The draw treats the
        teams alike, which makes the arena fair.
        """
        keys = jax.random.split(key, 5)
        robots = 2 * self.team_size
        radius = jax.random.uniform(keys[0], (), minval=self.rules.ring[0], maxval=self.rules.ring[1])
        diameter = jax.random.uniform(keys[1], (), maxval=2 * jnp.pi)
        side = jnp.repeat(jnp.array([0.0, jnp.pi]), self.team_size)
        spread = jnp.tile(_pitch(self.team_size) * (jnp.arange(self.team_size) - (self.team_size - 1) / 2), 2)
        wobble = jnp.repeat(jax.random.uniform(keys[2], (2,), minval=-WOBBLE, maxval=WOBBLE), self.team_size)
        angle = diameter + side + spread + wobble
        distance = radius * jax.random.uniform(keys[3], (robots,), minval=NEAREST, maxval=FARTHEST)
        heading = jax.random.uniform(keys[4], (robots,), maxval=2 * jnp.pi)
        zero = jnp.zeros(robots)
        height = jnp.full(robots, self.robots[self.agents[0].name].rest_height)
        base = jnp.stack(
            [distance * jnp.cos(angle), distance * jnp.sin(angle), height, jnp.cos(heading / 2), zero, zero,
             jnp.sin(heading / 2)], axis=1,
        )  # (robots, 7)  # fmt: skip
        qpos = self._rest.at[self._qpos].set(base)
        return qpos, jnp.zeros(self.scene.model.nv), Game(radius)

    def judge(self, before: Physics, physics: Physics, game: Game) -> tuple[Game, Verdict]:
        """Ring-out or fall of any robot loses; both in one control step, or no time left, is a draw."""
        radius = self.ring_radius(game, physics.time)
        now = self._pose(physics)
        out = (jnp.linalg.norm(now.xy, axis=1) > radius) | (now.up < UPRIGHT)
        lost = out.reshape(2, self.team_size).any(axis=1)  # (teams,)
        expired = physics.time >= self.rules.episode - self.timing.control_interval / 2
        decided = lost.any()
        both = lost.all()
        won = lost[::-1] & ~both
        reward = jnp.where(decided, won * 1.0 - (lost & ~both) * 1.0, -self.weights.timeout_penalty * expired)
        score = jnp.where(decided & ~both, won * 1.0, 0.5)
        shaping = self._shaping(self._pose(before), now)
        return game, Verdict(reward, shaping, score, decided | expired, jnp.zeros((), bool))

    def markers(self, physics: Physics, game: Game) -> dict[str, Array]:
        """The ring."""
        zero = jnp.zeros(())
        return {"ring": jnp.stack([zero, zero, self.ring_radius(game, physics.time)])}

    def _shaping(self, before: Pose, now: Pose) -> Array:
        """Dense reward of both teams (2,) for one control step, from metres gained."""
        n, w = self.team_size, self.weights
        outwards = jnp.linalg.norm(now.xy, axis=1) - jnp.linalg.norm(before.xy, axis=1)
        outwards = outwards.reshape(2, n).mean(axis=1)
        gained = (_nearest_enemy(before.xy, n) - _nearest_enemy(now.xy, n)).reshape(2, n).mean(axis=1)
        dense = w.approach * gained + w.push * (outwards[::-1] - outwards)
        limit = w.clip * self.timing.control_interval
        return jnp.clip(dense, -limit, limit)

    # Observations ----------------------------------------------------------------------------------------------------

    def _pose(self, physics: Physics) -> Pose:
        base, speed = physics.qpos[self._qpos], physics.qvel[self._qvel]  # (robots, 7), (robots, 6)
        quat = base[:, 3:]
        return Pose(base[:, :2], jax.vmap(yaw)(quat), speed[:, :2], speed[:, 5], jax.vmap(up_z)(quat))

    def observe(self, physics: Physics, game: Game, actions: dict[str, Array]) -> dict[str, Array]:
        """The table at the top of this file, for every agent."""
        pose = self._pose(physics)
        radius = self.ring_radius(game, physics.time)
        margin = radius - jnp.linalg.norm(pose.xy, axis=1)
        scene = jnp.stack([radius, physics.time / self.rules.episode])
        own = [
            _ahead(pose.heading, pose.velocity),
            pose.yaw_rate[:, None],
            _ahead(pose.heading, -pose.xy) / radius,
            margin[:, None],
            jnp.broadcast_to(scene, (len(self.agents), 2)),
            pose.up[:, None],
            jnp.stack([actions[agent.name] for agent in self.agents]),
        ]
        others = self._others(pose, margin)
        table = jnp.concatenate([*own, others.reshape(len(self.agents), -1)], axis=1)  # (robots, obs)
        return {agent.name: table[i] for i, agent in enumerate(self.agents)}

    def _others(self, pose: Pose, margin: Array) -> Array:
        """Nine numbers (robots, others, 9) about each other robot, in each one's heading frame."""
        you = self._order
        position = _ahead(pose.heading, pose.xy[you] - pose.xy[:, None])
        bearing = position / jnp.maximum(jnp.linalg.norm(position, axis=2, keepdims=True), 1e-6)
        angle = pose.heading[you] - pose.heading[:, None]
        velocity = _ahead(pose.heading, pose.velocity[you] - pose.velocity[:, None])
        facing = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=2)
        return jnp.concatenate([position, bearing, facing, velocity, margin[you][..., None]], axis=2)

    # Scripted opponents ----------------------------------------------------------------------------------------------

    def scripts(self) -> dict[str, Script]:
        """Anchors for the rating pool; they show slow progress that the score against the initial policy hides."""
        return {"idle": _idle, "random": _random, "pusher": self._pusher, "centre-holder": _centre_holder}

    def _pusher(self, observation: Array, key: Array) -> Array:
        """Drive straight at the nearest enemy at 0.9 of full speed, backwards where it is behind."""
        first = OWN + PER_OTHER * (self.team_size - 1)
        enemies = observation[first:].reshape(self.team_size, PER_OTHER)
        nearest = enemies[jnp.argmin(jnp.linalg.norm(enemies[:, :2], axis=1))]
        return _drive_towards(nearest[:2], jnp.asarray(0.9), observation[9])


def _idle(observation: Array, key: Array) -> Array:
    """Stand still."""
    return jnp.zeros(2)


def _random(observation: Array, key: Array) -> Array:
    """Every decision a fresh action, uniform over the whole range."""
    return jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)


def _centre_holder(observation: Array, key: Array) -> Array:
    """Drive to the centre of the ring and stay there: slower the nearer, so that the tyres keep their grip."""
    to_centre = observation[3:5] * observation[6]  # m
    distance = jnp.linalg.norm(to_centre)
    return _drive_towards(to_centre, jnp.clip(distance, 0.0, 0.6), observation[9])


def _drive_towards(position: Array, speed: Array, last_throttle: Array) -> Array:
    """Throttle and steering that bring a rover to a position (2,) in its heading frame, in reverse if it lies behind.

    In reverse, the angle that brings the rear onto a position has the sign of the angle that brings the nose onto its
    mirror image in front. A rover only circles round what lies inside its turning circle: it first draws away with the
    wheels turned the other way, as in a three-point turn, until the position is well outside the circle.
    """
    x, y = position
    towards = jnp.where(x > -0.3 * jnp.linalg.norm(position), 1.0, -1.0)
    circle = jnp.where(last_throttle * towards < 0, 0.8, 0.5)  # m, its radius; larger while drawing away
    away = jnp.where(jnp.hypot(x, jnp.abs(y) - circle) < circle, -1.0, 1.0)
    steering = jnp.clip(2.0 * jnp.arctan2(y, jnp.abs(x)), -1.0, 1.0)
    return jnp.stack([away * towards * speed, away * steering])


def _pitch(team_size: int) -> float:
    """Angle in radians between team-mates: 1.2, or what leaves as much between the teams however these wobble."""
    return min(1.2, (math.pi - 2 * WOBBLE) / team_size)


def _nearest_enemy(xy: Array, team_size: int) -> Array:
    """Distance in metres from each robot to its nearest enemy, (robots,)."""
    gap = jnp.linalg.norm(xy[:team_size, None] - xy[None, team_size:], axis=-1)  # (blue, red)
    return jnp.concatenate([gap.min(axis=1), gap.min(axis=0)])


def _listing(team_size: int) -> np.ndarray:
    """The other robots (robots, others) as each one lists them: team-mates, then enemies."""
    robots = np.arange(2 * team_size)
    rows = [sorted(np.delete(robots, me), key=lambda you: you // team_size != me // team_size) for me in robots]
    return np.array(rows)


def _ahead(heading: Array, vectors: Array) -> Array:
    """World vectors (robots, ..., 2) in each robot's heading frame: ahead, left.

    No matrix product: by default GPUs round its factors to 10 bits.
    """
    angle = heading.reshape(-1, *[1] * (vectors.ndim - 2))
    c, s, x, y = jnp.cos(angle), jnp.sin(angle), vectors[..., 0], vectors[..., 1]
    return jnp.stack([c * x + s * y, c * y - s * x], axis=-1)


ARENAS = (
    SumoSettings("sumo-1v1", team_size=1, rules=SumoRules(ring=(1.2, 1.8))),
    SumoSettings("sumo-2v2"),
)
