"""Sumo, stage 2: block push. Blue and red, one robot each, share a ring with two blocks; each team owns one block.

A game is over when the centre of a robot or a block is out of the ring, or a robot has fallen. A team gains a point if
its block is out and loses one if its robot is out; the team with more points wins. The robots need not touch: both may
push undisturbed, and the faster one wins. The end of the time is a draw that cuts the game off (`truncated`): the clock
is not observed and costs nothing, so the learner bootstraps there.

The observation has HARL-A's slots (`arenas/games/sumo/paper_observation.py`): A is the own block, B the other robot, C
the other's block.
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
from arenas.games.sumo import paper_observation, ring, scripts
from arenas.games.sumo.stages import BlockPushRules, BlockPushSettings
from arenas.physics.engine import Physics
from arenas.robots.anymal import anymal
from arenas.robots.leatherback import leatherback
from arenas.robots.robot import Robot, Script
from arenas.scene import props
from arenas.scene.colours import TEAM_COLOURS
from arenas.scene.starts import upright_poses
from arenas.state import Verdict

CONTROL = 0.02  # s
AGENTS, BLOCKS = ("blue/0", "red/0"), ("block-blue", "block-red")
FACING = {"anymal": jnp.pi / 2, "leatherback": 0.0}  # rad, initial headings of HARL-A's robots of each kind
TROT = -0.5  # speed command of the ANYmals' pusher to its gait, see `scripts.Pace`
FULL_SPEED, FULL_STEERING = 40.0, 0.6  # rad/s of the wheels, rad: full throttle and steering of the rovers' pusher
SLOTS = ("own block", "the other robot", "the other's block")
# Slots for pairs of near geoms and for contacts. Two untrained ANYmals need 31 on average, rovers 14 for pairs and 18
# for contacts (`benchmarks/buffers.py`); at most 98 and 80 rows were seen. A block lies on four contacts, and boxes
# touch at up to eight.
CONTACTS, ROWS = {"anymal": 44, "leatherback": 32}, {"anymal": 144, "leatherback": 128}


class GameState(NamedTuple):
    """The ring of this episode."""

    radius: Array  # () m


class Places(NamedTuple):
    """Positions of robots and blocks."""

    robots: Array  # (teams, 3) m
    blocks: Array  # (teams, 3) m


class BlockPush(Arena):
    """Two robots of one kind and their blocks."""

    exchangeable = True

    def __init__(self, settings: BlockPushSettings, **options: Unpack[EngineOptions]):
        rules = settings.rules
        self.robot = _robot(settings.robot, rules)
        half = rules.block_side / 2
        blocks = [
            props.block(name, half=(half, half, half), mass=rules.block_mass, at=(side, 1.0), colour=colour)
            for name, side, colour in zip(BLOCKS, (1.0, -1.0), TEAM_COLOURS, strict=False)
        ]
        super().__init__(
            settings.name, {"blue": (self.robot,), "red": (self.robot,)}, settings.timing,
            {**asdict(rules), "randomisation": asdict(settings.randomisation)}, props=blocks,
            solver=Solver(contacts=CONTACTS[settings.robot], rows=ROWS[settings.robot]),
            marker_kinds={"ring": "circle"}, **options,
        )  # fmt: skip
        self.rules, self.weights, self.buffer = rules, settings.reward, settings.buffer
        self.randomisation = settings.randomisation
        self.randomisation.check(self.scene)
        self._robots = np.array([self.scene.agents[name].qpos for name in AGENTS])
        self._blocks = np.array([self.scene.props[name].qpos for name in BLOCKS])
        self._rest = jnp.asarray(self.scene.rest, jnp.float32)
        self._clear = rules.clear(settings.robot)

    def observation_size(self, agent: str) -> int:
        """Return the observation's size: 56 numbers of an ANYmal, 14 of a rover, and the buffer."""
        return paper_observation.size(self.robot.kind, 0, self.buffer)

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the observation, in which all slots are filled."""
        return paper_observation.slot_parts(self.robot.kind, self.robot.sensed_parts, SLOTS, self.buffer)

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the terms."""
        counts = "out of the ring or fallen" if self.rules.falls == "lose" else "out of the ring"
        return Legend(
            score=f"1 for the team with more points when the game is over: its block out of the ring counts 1, its"
            f" robot {counts} -1; ½ each if equal, and when time is up",
            rewards=dict.fromkeys(("block_out", "robot_out", "block", "near", "time"), ""),
            shapings=dict.fromkeys(("approach", "push"), ""),
            events={
                "block_out": "the team's own block is out of the ring",
                "out": "its robot is out of the ring",
                "fall": "its robot has fallen",
            },
        )

    # Rules -----------------------------------------------------------------------------------------------------------

    def place(self, key: Array) -> tuple[Array, Array, GameState]:
        """Place robots and blocks on a lattice within the ring, clear of each other."""
        size, where, turn = jax.random.split(key, 3)
        rules = self.rules
        radius = jax.random.uniform(size, minval=rules.ring[0], maxval=rules.ring[1])
        xy = ring.place_on_lattice(where, rules.spawn * radius, self._clear, rules.spawn * rules.ring[1])
        heading = jax.random.uniform(turn, (4,), maxval=2 * jnp.pi)
        if rules.heading == "fixed":
            facing = FACING[self.robot.kind]
            heading = jnp.array([facing, facing, 0.0, 0.0])
        height = jnp.array([self.robot.rest_height] * 2 + [rules.block_side / 2] * 2)
        at = np.concatenate([self._robots, self._blocks])[:, None] + np.arange(7)
        qpos = self._rest.at[at].set(upright_poses(xy, heading, height))
        return qpos, jnp.zeros(self.scene.model.nv), GameState(radius)

    def randomise(self, key: Array) -> dict[str, Array]:
        """Draw model fields by the settings."""
        return self.randomisation.draw(key, self.scene)

    def exchange(
        self, qpos: Array, qvel: Array, game: GameState, order: Sequence[int] = (1, 0)
    ) -> tuple[Array, Array, GameState]:
        """Exchange the blocks together with the robots that own them."""
        changed, moved, game = super().exchange(qpos, qvel, game, order)
        speeds = np.array([self.scene.props[name].qvel for name in BLOCKS])[:, None] + np.arange(6)
        poses = self._blocks[:, None] + np.arange(7)
        places = list(order)
        return changed.at[poses].set(qpos[poses[places]]), moved.at[speeds].set(qvel[speeds[places]]), game

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Count the own block out for a team, the own robot out or fallen against it; the higher count wins."""
        was, now = self._places(before), self._places(physics)
        fall = self.fallen(physics)
        block_out, robot_out = _far(now.blocks) > game.radius, _far(now.robots) > game.radius
        lost = robot_out | fall if self.rules.falls == "lose" else robot_out
        count = 1.0 * block_out - 1.0 * lost  # (teams,)
        over = (block_out | robot_out | fall).any()
        late = physics.time > self.rules.episode - self.timing.control_interval / 2
        return game, Verdict(
            rewards=self._rewards(now, block_out, lost),
            shapings=self._hints(was, now),
            score=0.5 + 0.5 * jnp.sign(count - count[::-1]),
            terminated=over,
            truncated=late & ~over,
            events={"block_out": block_out, "out": robot_out, "fall": fall},
        )

    def _rewards(self, now: Places, block_out: Array, lost: Array) -> dict[str, Array]:
        """Return HARL-A's terms, each (teams,). Distances are in three dimensions, from the centre on the ground."""
        w, dt, far = self.weights, self.timing.control_interval, self.rules.ring[1]
        off_centre, apart = _length(now.blocks), _length(now.robots - now.blocks)
        return {
            "block_out": w.block_out * block_out,
            "robot_out": w.robot_out * lost,
            "block": w.block * dt * jnp.tanh(off_centre / far),
            "near": w.near * dt * (1.0 - jnp.tanh(apart / far)),
            "time": jnp.full(2, w.time),
        }

    def _hints(self, was: Places, now: Places) -> dict[str, Array]:
        gained = _length(was.robots - was.blocks) - _length(now.robots - now.blocks)
        return {
            "approach": self.weights.approach * gained,
            "push": self.weights.push * (_far(now.blocks) - _far(was.blocks)),
        }

    def markers(self, physics: Physics, game: GameState) -> dict[str, Array]:
        """Return the ring."""
        return {"ring": jnp.zeros(3).at[2].set(game.radius)}

    def _places(self, physics: Physics) -> Places:
        qpos, xyz = physics.qpos, np.arange(3)
        return Places(qpos[self._robots[:, None] + xyz], qpos[self._blocks[:, None] + xyz])

    # Observations and scripts ----------------------------------------------------------------------------------------

    def observe(self, physics: Physics, game: GameState, actions: dict[str, Array]) -> dict[str, Array]:
        """Return the observations: slots A, B and C are the own block, the other robot and its block."""
        at, observations = self._places(physics), {}
        for mine, agent in enumerate(AGENTS):
            body, other = self.body(agent, physics, actions), 1 - mine
            points = (at.blocks[mine], at.robots[other], at.blocks[other])
            a, b, c = (paper_observation.in_base_frame(body, point) for point in points)
            distance = _length(at.robots[mine])
            observations[agent] = paper_observation.fill(
                self.robot, body, a, b, c, distance, game.radius, buffer=self.buffer
            )
        return observations

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return a script that drives straight at the own block, which is ahead and therefore leaves the ring first.

        The slots do not contain the ring's centre. An ANYmal turns on a circle of 1.2 m, and often leaves the ring on
        it without its block.
        """
        kind, rules = self.robot.kind, self.rules
        at = paper_observation.first_index(kind, "a")
        view = scripts.slots_view(kind)._replace(enemies=lambda observations: observations[at : at + 3][None])
        pace = scripts.Pace(CONTROL, FULL_SPEED / rules.drive_scale, FULL_STEERING / rules.steer_scale, TROT)
        return {"pusher": {kind: scripts.pusher(kind, view, pace)}}


def _robot(kind: str, rules: BlockPushRules) -> Robot:
    if kind == "anymal":
        return anymal(rules.fall_height, rules.fall_up)
    return leatherback(rules.drive_scale, rules.steer_scale, limit=None, wheel_limit=rules.wheel_limit)


def _length(vectors: Array) -> Array:
    return jnp.sqrt(jnp.sum(vectors**2, axis=-1))


def _far(points: Array) -> Array:
    """Return distances (n,) in m of points (n, 3) from the ring's centre along the ground."""
    return _length(points[:, :2])
