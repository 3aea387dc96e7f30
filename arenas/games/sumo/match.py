"""Sumo's matches: two teams of robots in a ring; the first team with a robot outside, or fallen, loses.

| term of the reward | when                                                   | each team                              |
|--------------------|--------------------------------------------------------|----------------------------------------|
| result             | one team lost / both in the same control step          | +scale and -scale / 0 and 0            |
| timeout            | the time is up (a terminal state: the penalty is part of the game) | -scale × timeout_penalty   |
| dense (shaping)    | every control step                                     | see `SumoReward`                       |

Events: `out` (a robot of the team is outside the ring), `fall` (one has fallen, by the rule of its own kind).

Both sides may have any robots. The rules are those of the quick start (rovers at 10 Hz in a small ring that shrinks:
sudden death), HARL-A's (50 Hz, a constant ring, reward for the outcome alone), or anything in between. Observations are
in `full_observation.py` and `paper_observation.py`, starts in `ring.py`, scripts in `scripts.py`. `docs/arenas/sumo.md`
explains each setting.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions, Solver
from arenas.description import Legend, Part
from arenas.errors import ArenaError
from arenas.games.sumo import ring, scripts
from arenas.games.sumo.full_observation import FullObservation
from arenas.games.sumo.paper_observation import PaperObservation
from arenas.games.sumo.settings import CONTROL, ITERATIONS, SPARE_CONTACTS, SPARE_ROWS, SumoRules, SumoSettings
from arenas.physics.engine import Physics
from arenas.robots.anymal import anymal
from arenas.robots.files.loading import file_robot
from arenas.robots.kinds import KINDS, kind_of
from arenas.robots.leatherback import leatherback
from arenas.robots.minitank import minitank
from arenas.robots.robot import Robot, Script
from arenas.scene.starts import upright_poses
from arenas.state import Verdict

DEFAULT_KIND = KINDS["anymal"]  # supplies the buffer sizes of robots from custom rosters


class GameState(NamedTuple):
    """The ring of this episode."""

    radius: Array  # () m at the start


class Sumo(Arena):
    """Blue against red, with the robots of the settings, or those of `rosters`, which must name two teams."""

    exchangeable = True

    def __init__(
        self,
        settings: SumoSettings,
        rosters: Mapping[str, Sequence[Robot]] | None = None,
        **options: Unpack[EngineOptions],
    ):
        rules = settings.rules
        sides = {"blue": settings.blue, "red": settings.red}
        if rosters is None:
            rosters = {team: [_robot(kind, rules) for kind in kinds] for team, kinds in sides.items()}
            room = [kind_of(kind) for kinds in sides.values() for kind in kinds]
        else:
            room = [KINDS.get(robot.kind, DEFAULT_KIND) for team in rosters.values() for robot in team]
        if len(rosters) != 2:
            raise ArenaError(f"sumo needs two teams; these are {', '.join(rosters)}")
        super().__init__(
            settings.name, rosters, settings.timing, asdict(rules) | {"randomisation": asdict(settings.randomisation)},
            solver=Solver(
                iterations=ITERATIONS,
                contacts=SPARE_CONTACTS + sum(kind.contacts for kind in room),
                rows=SPARE_ROWS + sum(kind.rows for kind in room),
            ),
            marker_kinds={"ring": "circle"}, **options,
        )  # fmt: skip
        self.rules, self.weights, self.randomisation = rules, settings.reward, settings.randomisation
        self.randomisation.check(self.scene)
        blue, red = (len(members) for members in rosters.values())
        self.sizes = blue, red
        self._sides = slice(0, blue), slice(blue, blue + red)
        rich = settings.observation == "rich"
        self._observation_builder = (
            FullObservation(self.robots, self.sizes)
            if rich
            else PaperObservation(self.robots, self.sizes, settings.buffer)
        )
        self._game_scripts = self._of_kinds(rich)
        index = [self.scene.agents[name] for name in self.robots]
        self._qpos = np.array([i.qpos for i in index])[:, None] + np.arange(7)
        self._rest = jnp.asarray(self.scene.rest, jnp.float32)
        self._heights = jnp.array([robot.rest_height for robot in self.robots.values()])

    def observation_size(self, agent: str) -> int:
        """Return the size of the agent's observation."""
        return self._observation_builder.size(agent)

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the agent's observation."""
        return self._observation_builder.parts(agent)

    def legend(self) -> Legend:
        """Describe the verdict with the weights of the settings."""
        w = self.weights
        lost = "out of the ring" if self.rules.defects.falls_uncounted else "out of the ring or fallen"
        paid = (
            f"{w.approach:+g} per metre gained towards the nearest enemy, {w.push:+g} per metre by which enemies moved"
            f" outwards more than the own robots, means over the team; within ±{w.clip:g} per second"
        )
        return Legend(
            score=f"0 for a team that has a robot {lost}, 1 for the other; ½ each where both have in one control step,"
            " and when time is up",
            rewards={
                "result": f"at the end: {w.scale:+g} for a win, {-w.scale:+g} for a loss",
                "timeout": f"{-w.scale * w.timeout_penalty:+g} for both when time is up",
            },
            shapings={"dense": paid if w.approach or w.push else "nothing: its weights are 0"},
            events={"out": "a robot of the team is out of the ring", "fall": "a robot of the team has fallen"},
        )

    # Start -----------------------------------------------------------------------------------------------------------

    def place(self, key: Array) -> tuple[Array, Array, GameState]:
        """Place all robots at rest in the ring, clear of each other, with places and headings by the settings.

        Both kinds of draw treat the teams alike, which makes an arena of equal teams fair.
        """
        rules, robots = self.rules, len(self.robots)
        keys = jax.random.split(key, 5)
        radius = jax.random.uniform(keys[0], (), minval=rules.ring[0], maxval=rules.ring[1])
        if rules.spawn == "lattice":
            xy = ring.place_on_lattice(keys[1], radius, [rules.spawn_distance / 2] * robots, rules.ring[1])
        else:
            xy = ring.place_on_diameter(keys[1:4], radius, self.sizes)
        heading = jax.random.uniform(keys[4], (robots,), maxval=2 * jnp.pi)
        if rules.heading == "fixed":
            heading = jnp.full(robots, jnp.pi / 2)
        qpos = self._rest.at[self._qpos].set(upright_poses(xy, heading, self._heights))
        return qpos, jnp.zeros(self.scene.model.nv), GameState(radius)

    def randomise(self, key: Array) -> dict[str, Array]:
        """Draw model fields by the settings."""
        return self.randomisation.draw(key, self.scene)

    # Rules -----------------------------------------------------------------------------------------------------------

    def ring_radius(self, game: GameState, time: Array) -> Array:
        """Return the current radius in metres: constant, then falling linearly until time is up."""
        r = self.rules
        if r.shrink_after >= r.episode:
            return game.radius
        late = jnp.clip((time - r.shrink_after) / (r.episode - r.shrink_after), 0.0, 1.0)
        return game.radius * (1.0 - (1.0 - r.shrink_to) * late)

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Judge ring-outs and falls: a team loses by either. Both teams in one control step, or the end of time, is a
        draw.
        """
        radius = self.ring_radius(game, physics.time)
        was, now = self._xy(before), self._xy(physics)
        out = self._by_team(jnp.any, jnp.linalg.norm(now, axis=1) > radius)
        fall = self._by_team(jnp.any, self.fallen(physics))
        lost = out | fall  # (teams,)
        expired = physics.time >= self.rules.episode - self.timing.control_interval / 2
        decided, scale = lost.any(), self.weights.scale
        timeout = jnp.full(2, -scale * self.weights.timeout_penalty) * (expired & ~decided)
        return game, Verdict(
            rewards={"result": scale * (_won(lost) * 1.0 - _won(lost)[::-1] * 1.0), "timeout": timeout},
            shapings={"dense": self._shaping(was, now)},
            score=_score(out if self.rules.defects.falls_uncounted else lost),
            terminated=decided | expired,
            truncated=jnp.zeros((), bool),
            events={"out": out, "fall": fall},
        )

    def markers(self, physics: Physics, game: GameState) -> dict[str, Array]:
        """Return the ring."""
        zero = jnp.zeros(())
        return {"ring": jnp.stack([zero, zero, self.ring_radius(game, physics.time)])}

    def _shaping(self, before: Array, now: Array) -> Array:
        """Return the dense reward of both teams (2,) for one control step, from places (robots, 2) before and after."""
        w = self.weights
        outwards = self._by_team(jnp.mean, jnp.linalg.norm(now, axis=1) - jnp.linalg.norm(before, axis=1))
        gained = self._by_team(jnp.mean, self._nearest_enemy(before) - self._nearest_enemy(now))
        dense = w.approach * gained + w.push * (outwards[::-1] - outwards)
        limit = w.clip * self.timing.control_interval
        return jnp.clip(dense, -limit, limit)

    def _by_team(self, summary: Callable[[Array], Array], robots: Array) -> Array:
        """Summarise numbers per robot (robots,) for each team, (teams,); teams may be of unequal size."""
        return jnp.stack([summary(robots[side]) for side in self._sides])

    def _nearest_enemy(self, xy: Array) -> Array:
        """Return the distance in metres from each robot to its nearest enemy, (robots,)."""
        blue, red = (xy[side] for side in self._sides)
        gap = jnp.linalg.norm(blue[:, None] - red[None], axis=-1)  # (blue, red)
        return jnp.concatenate([gap.min(axis=1), gap.min(axis=0)])

    def _xy(self, physics: Physics) -> Array:
        """Return the positions of the bases, (robots, 2) m."""
        return physics.qpos[self._qpos[:, :2]]

    # Observations and scripts -----------------------------------------------------------------------------------------

    def observe(self, physics: Physics, game: GameState, actions: dict[str, Array]) -> dict[str, Array]:
        """Return the observations of all agents."""
        bodies = {agent: self.body(agent, physics, actions) for agent in self.robots}
        radius = self.ring_radius(game, physics.time)
        return self._observation_builder.observe(bodies, radius, physics.time / self.rules.episode)

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return anchors for the ratings, which show slow progress that the score against the initial policy hides."""
        return self._game_scripts

    def _of_kinds(self, rich: bool) -> dict[str, dict[str, Script]]:
        """Make the game's scripts. With unequal teams a script with the full observation reads only as many enemies as
        fit both.
        """
        feelings = {robot.kind: robot.proprioception_size for robot in self.robots.values()}
        views = {
            kind: scripts.full_view(proprioception_size, min(self.sizes)) if rich else scripts.slots_view(kind)
            for kind, proprioception_size in feelings.items()
        }
        decision, rover = self.timing.control_interval * self.timing.hold, SumoRules()
        throttle, steering = rover.drive_scale / self.rules.drive_scale, rover.steer_scale / self.rules.steer_scale
        return scripts.of_match(views, scripts.Pace(decision, throttle, steering), self.robots.values())


def _won(lost: Array) -> Array:
    """Return (teams,) bool: the teams whose enemy alone lost (teams,)."""
    return lost[::-1] & ~lost


def _score(lost: Array) -> Array:
    """Return scores (teams,) from losses (teams,); if both or neither lost it is a draw."""
    return jnp.where(lost[0] == lost[1], 0.5, _won(lost) * 1.0)


def _robot(kind: str, rules: SumoRules) -> Robot:
    """Make a robot by its name in a roster."""
    return _BUILD[kind](rules) if kind in _BUILD else file_robot(kind)


def _rover(rules: SumoRules) -> Robot:
    clamp = None if rules.defects.throttle_unclamped else rules.wheel_limit
    return leatherback(rules.drive_scale, rules.steer_scale, rules.drive_limit, clamp)


def _quadruped(rules: SumoRules) -> Robot:
    return anymal(rules.fall_height, rules.fall_up, decision=CONTROL * rules.decide_every)


_BUILD: Mapping[str, Callable[[SumoRules], Robot]] = {
    "leatherback": _rover,
    "anymal": _quadruped,
    "minitank": lambda rules: minitank(),
}
