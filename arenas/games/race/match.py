"""Gate race: drones, each a team of its own, race through the gates of a track. After 2512.11781.

| a race ends when                                    | who wins                                                      |
|-----------------------------------------------------|---------------------------------------------------------------|
| a drone has completed the laps                      | the drone that has passed more gates; of equal ones the drone |
| no drone flies, or time is up                       | that passed its last one earlier, to a part of a control step |

Gates are no bodies. A drone has passed its next gate when the straight way of its centre during a control step leads
through the opening in the right direction. Its flight ends early when that way crosses the gate's plane beside the
opening, when it leaves the box, is too low, or touches walls, ground or other drones for too long. It then is out of
the game and its motors stop; its gates count. The clock is a rule: its end is terminal, and it is observed.

Collisions are physical; a touch is judged by distance, of a sphere round the drone, so that all engines agree.
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
from arenas.description import Entities, Legend, Part
from arenas.games.race import observation, scripts
from arenas.games.race.crossings import Gates, cross, place_gates, wall_gaps
from arenas.games.race.settings import TEAMS, RaceSettings
from arenas.games.race.tracks import SIDE, TRACKS, Gate, Wall, X, Y, Z
from arenas.physics.engine import Physics
from arenas.robots.crazyflie import ARM, ROTOR_RADIUS, crazyflie_rates
from arenas.robots.robot import Script
from arenas.scene import props
from arenas.scene.starts import upright_poses
from arenas.state import Verdict

RADIUS, TOUCH = ARM + ROTOR_RADIUS, 0.01  # m, of the sphere round a drone, and the gap up to which it touches
BEHIND = (1.2, 1.6)  # m before the gate, at the start
GRID = np.array([[-0.3, 0.0], [0.3, 0.0], [-0.3, 0.4], [0.3, 0.4]])  # m left and up of the gate's centre
HALO = 0.25  # m, drawn radius round a drone
CONTACTS, ROWS = 8, 4  # Warp's slots for each drone, as in Galaga, and rows for each slot


class GameState(NamedTuple):
    """State of a race besides the drones' places."""

    gate: Array  # () int32, number of the gate before which all started
    passed: Array  # (drones,) int32 gates
    at: Array  # (drones,) seconds of the episode when the latest gate was passed; 0 before
    contacts: Array  # (drones,) int32 control steps in which a drone touched something
    flying: Array  # (drones,) bool


class Race(Arena):
    """A race of one to four drones."""

    exchangeable = True

    def __init__(self, settings: RaceSettings, **options: Unpack[EngineOptions]):
        rules, track, number = settings.rules, TRACKS[settings.rules.track], settings.teams
        self.walls = track.walls if rules.walls else ()
        teams = TEAMS[:number]
        super().__init__(
            settings.name, dict.fromkeys(teams, (crazyflie_rates(-1.0),)), settings.timing, asdict(rules),
            props=(*_frames(track.gates), *_walls(self.walls)),
            marker_kinds={f"{what}-{team}": kind for team in teams for what, kind in _MARKERS.items()},
            solver=Solver(contacts=CONTACTS * number, rows=ROWS * CONTACTS * number), **options,
        )  # fmt: skip
        self.rules, self.weights, self.number, self.settings = rules, settings.reward, number, settings
        self.gates, self.total = place_gates(track.gates), rules.laps * len(track.gates)
        at = list(self.scene.agents.values())
        self._pose = np.array([each.qpos for each in at])[:, None] + np.arange(7)
        self._motion = np.array([each.qvel for each in at])[:, None] + np.arange(6)
        self._rest = jnp.asarray(self.scene.rest, jnp.float32)

    def observation_size(self, agent: str) -> int:
        """Return the size of the observation, which is the same for all."""
        return sum(part.size for part in self.observation_parts(agent))

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the observation."""
        return observation.parts(self.settings.others)

    def observation_entities(self, agent: str) -> tuple[Entities, ...]:
        """Name the other drones as a set."""
        return observation.entities(self.settings.others)

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the terms."""
        return Legend(
            score="1 if it completed the laps" if self.number == 1 else "more gates passed; of equal ones, earlier",
            rewards=dict.fromkeys(("first", "later", "lap", "death", "contact", "rates", "yaw"), ""),
            shapings={"progress": ""},
            events={
                "gate": "it passed its next gate", "lap": "it completed the laps", "contact": "it touched something",
                "miss": "it crossed the plane of its next gate beside the opening",
                "crash": "it left the box, was too low or touched something for too long",
            },
        )  # fmt: skip

    # Start -----------------------------------------------------------------------------------------------------------

    def place(self, key: Array) -> tuple[Array, Array, GameState]:
        """Put all before a gate, level and at rest, at different distances and in a random order."""
        which, order, far = jax.random.split(key, 3)
        any_gate = self.rules.start == "any gate"
        gate = jax.random.randint(which, (), 0, len(self.gates.centre), jnp.int32) if any_gate else jnp.int32(0)
        slots = jax.random.permutation(order, jnp.asarray(GRID[: self.number] * (self.number > 1), jnp.float32))
        back = jax.random.uniform(far, (self.number, 1), minval=BEHIND[0], maxval=BEHIND[1])
        centre, ahead, left = (each[gate] for each in self.gates[:3])
        at = centre - back * ahead + slots[:, :1] * left
        heading = jnp.full(self.number, jnp.arctan2(ahead[1], ahead[0]))
        qpos = self._rest.at[self._pose].set(upright_poses(at[:, :2], heading, at[:, 2] + slots[:, 1]))
        none = jnp.zeros(self.number, jnp.int32)
        return qpos, jnp.zeros(self.scene.model.nv), GameState(gate, none, jnp.zeros(self.number), none, none == 0)

    def exchange(
        self, qpos: Array, qvel: Array, game: GameState, order: Sequence[int] = (1, 0)
    ) -> tuple[Array, Array, GameState]:
        """Put the drones in each other's places, with their race so far."""
        qpos, qvel, _ = super().exchange(qpos, qvel, game, order)
        from_team = jnp.array(order)
        return qpos, qvel, game._replace(**{f: getattr(game, f)[from_team] for f in GameState._fields if f != "gate"})

    def alive(self, physics: Physics, game: GameState) -> Array:
        """Return (agents,) bool: the drones that fly."""
        return game.flying

    # Rules -----------------------------------------------------------------------------------------------------------

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Judge the control step at each drone's next gate, and whatever ends flights and the race."""
        was, now = before.qpos[self._pose[:, :3]], physics.qpos[self._pose[:, :3]]
        gates = self._next(game, 0)
        crossed = cross(gates, was, now)
        passes, misses = game.flying & crossed.inside, game.flying & crossed.outside
        passed = game.passed + passes
        moment = before.time + crossed.when * self.timing.control_interval
        at = jnp.where(passes, moment, game.at)
        touches = game.flying & self._touches(now)
        contacts = game.contacts + touches
        laps = passed >= self.total
        crashes = game.flying & ~laps & ((contacts > self.rules.contacts) | self._outside(now, physics.time))
        after = GameState(game.gate, passed, at, contacts, game.flying & ~misses & ~crashes)
        late = physics.time > self.rules.episode - self.timing.control_interval / 2
        nearer = _length(was - gates.centre) - _length(now - gates.centre)
        return after, Verdict(
            rewards=self._rewards(physics, game, after, passes, touches),
            shapings={"progress": self.weights.progress * game.flying * nearer},
            score=self._score(after),
            terminated=laps.any() | ~after.flying.any() | late,
            truncated=jnp.zeros((), bool),
            events={"gate": passes, "lap": laps, "contact": touches, "miss": misses, "crash": crashes},
        )

    def _rewards(self, physics: Physics, game: GameState, after: GameState, passes: Array, touches: Array) -> dict:
        """Return the terms of the outcome, (drones,) each."""
        w, dt = self.weights, self.timing.control_interval
        # (drones, drones): the first had passed the gate of the second, or passed it earlier in this step
        level = passes[:, None] & (after.passed[:, None] == after.passed) & (after.at[:, None] < after.at)
        ahead = level | (game.passed[:, None] >= after.passed)
        place = ahead.sum(axis=0)
        rates = game.flying[:, None] * physics.qvel[self._motion[:, 3:]] ** 2
        return {
            "first": w.first * (passes & (place == 0)),
            "later": w.later * jnp.where(passes & (place > 0), 0.5 ** (place - 1.0), 0.0),
            "lap": w.lap * (passes & (after.passed >= self.total) & (place == 0)),
            "death": w.death * (game.flying & ~after.flying),
            "contact": w.contact * touches,
            "rates": w.rates * dt * (rates[:, 0] + rates[:, 1]),
            "yaw": w.yaw * dt * rates[:, 2],
        }

    def _score(self, game: GameState) -> Array:
        """Return the score: of one drone its success, of two the outcome, of more how many a drone beats."""
        if self.number == 1:
            return 1.0 * (game.passed >= self.total)
        beats = _beats(game.passed, game.at)
        score = beats.sum(axis=1) - 1.0 * beats.sum(axis=0)
        return (1.0 + score) / 2 if self.number == 2 else score

    def _touches(self, at: Array) -> Array:
        """Return (drones,) bool: drones at (drones, 3) m that touch another, a wall or the ground."""
        gaps = _length(at[:, None] - at) + 1e3 * np.eye(self.number, dtype=np.float32)
        near = (gaps.min(axis=1) - 2 * RADIUS) <= TOUCH
        return near | (wall_gaps(self.walls, at) - RADIUS <= TOUCH) | (at[:, 2] - RADIUS <= TOUCH)

    def _outside(self, at: Array, time: Array) -> Array:
        """Return (drones,) bool: drones at (drones, 3) m outside of the box, or too low after the time to take off."""
        low = (at[:, 2] <= Z[0]) & (time > self.rules.take_off)
        wide = (at[:, 0] < X[0]) | (at[:, 0] > X[1]) | (at[:, 1] < Y[0]) | (at[:, 1] > Y[1])
        return low | wide | (at[:, 2] > Z[1])

    def _next(self, game: GameState, later: int) -> Gates:
        """Return each drone's next gate, or one `later`, a row each."""
        return Gates(*(each[(game.gate + game.passed + later) % len(each)] for each in self.gates))

    # Observations, scripts and markers -------------------------------------------------------------------------------

    def observe(self, physics: Physics, game: GameState, actions: dict[str, Array]) -> dict[str, Array]:
        """Return the observations of `arenas/games/race/observation.py`."""
        gates = jnp.stack([self._next(game, later).corners for later in (0, 1)], axis=1)  # (drones, 2, 4, 3)
        poses, velocity = physics.qpos[self._pose], physics.qvel[self._motion[:, :3]]
        standing = observation.Standing(game.passed, game.flying, game.contacts / max(1, self.rules.contacts))
        time = physics.time / self.rules.episode
        return {
            agent: observation.observe(
                i, poses[i], robot.observe_self(self.body(agent, physics, actions)), gates[i], poses[:, :3], velocity,
                standing, self.total, time, self.settings.others,
            )
            for i, (agent, robot) in enumerate(self.robots.items())
        }  # fmt: skip

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return the scripts of `arenas/games/race/scripts.py`."""
        return scripts.of_game()

    def markers(self, physics: Physics, game: GameState) -> dict[str, Array]:
        """Return a sphere round each drone that flies, which is small in so wide a field, and the way to its gate."""
        at, to, found = physics.qpos[self._pose[:, :3]], self._next(game, 0).centre, {}
        for i, team in enumerate(TEAMS[: self.number]):
            found[f"drone-{team}"] = jnp.append(at[i], HALO * game.flying[i])
            found[f"way-{team}"] = jnp.concatenate([at[i], jnp.where(game.flying[i], to[i], at[i])])
        return found


_MARKERS = {"drone": "sphere", "way": "segment"}


def _beats(passed: Array, at: Array) -> Array:
    """Return (drones, drones) bool: the first has passed more gates than the second, or as many and earlier."""
    return (passed[:, None] > passed) | ((passed[:, None] == passed) & (at[:, None] < at))


def _length(vectors: Array) -> Array:
    return jnp.sqrt(jnp.sum(vectors**2, axis=-1))


def _frames(gates: Sequence[Gate]) -> list[props.Prop]:
    return [
        props.frame(f"gate-{i}", at=gate[:3], heading=float(np.radians(gate.heading)), side=SIDE)
        for i, gate in enumerate(gates)
    ]


def _walls(walls: Sequence[Wall]) -> list[props.Prop]:
    return [
        props.wall(f"wall-{i}", at=(wall.x, wall.y, Z[1] / 2), half=(wall.along_x, wall.along_y, Z[1] / 2))
        for i, wall in enumerate(walls)
    ]
