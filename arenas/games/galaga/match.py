"""3D Galaga: tanks, the team blue, aim; drones, the team red, fly to their goals unless they are hit first.

| a game ends when                                                   | who wins                                   |
|--------------------------------------------------------------------|--------------------------------------------|
| `goals` drones have reached their goals                            | the drones                                 |
| too few drones live or have arrived for that                       | the tanks                                  |
| both in one control step                                           | a draw                                     |
| no time left                                                       | a draw that is cut off, or as `timeout` says |

A drone is dead when it is hit, or at the `floor` or below. It stays dead and is out of the game: its motors stop, and
it can no longer be hit, reach its goal or earn reward. A tank whose drone is dead observes the next living one.

One tank and one drone (HARL-A's `main`), two of each within walls (the paper's), and any other numbers are settings of
one game. Observations are in `observation.py`, starts and hits of barrels in `geometry.py`, scripts in `scripts.py`.
`docs/arenas/galaga.md` explains each setting.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions, Solver
from arenas.description import Legend, Part
from arenas.games.galaga import geometry, scripts
from arenas.games.galaga.geometry import Barrel, barrel
from arenas.games.galaga.observation import Drone, ObservationBuilder
from arenas.games.galaga.observation_layout import parts, size
from arenas.games.galaga.settings import FIELD, HULLS, GalagaSettings
from arenas.physics.engine import Physics
from arenas.robots.crazyflie import crazyflie
from arenas.robots.minitank import from_x, minitank
from arenas.robots.robot import Robot, Script
from arenas.scene import props
from arenas.scene.starts import upright_poses
from arenas.state import Verdict

WALL, TALL = 0.25, 1.0  # m, half a wall's thickness and height
BEAM = 12.0  # m, drawn length of the laser
TOLERANCE = 0.07  # rad, about the tolerance of `aim_error` = 0.05: radius of the sphere drawn round a drone
# Warp's slots for each robot, and rows for each slot. Random play that started in a corner, by a wall, used at most 18
# of 32 contacts and 74 of 128 rows in the 2v2 game, and 8 of 16 and 33 of 64 on an open plane.
CONTACTS, ROWS = {"minitank": 8, "crazyflie": 8}, 4


class GameState(NamedTuple):
    """State of a game besides the robots' places."""

    goals: Array  # (drones, 3) m in the world
    alive: Array  # (drones,) bool
    reached: Array  # (drones,) bool: drones that have been at their goals
    pending: Array  # (teams,) bool: winners of the previous control step; only for `late_end`


class Galaga(Arena):
    """Blue tanks against red drones, in the numbers of the settings."""

    def __init__(self, settings: GalagaSettings, **options: Unpack[EngineOptions]):
        rules = settings.rules
        drone = drone_robot(rules.floor)
        if rules.defects.drift:
            drone = replace(drone, limp=())
        rosters = {"blue": [minitank(rules.tank_speed)] * settings.tanks, "red": [drone] * settings.drones}
        contacts = sum(CONTACTS[robot.kind] for team in rosters.values() for robot in team)
        self.tanks, self.drones = ([f"{team}/{i}" for i in range(len(rosters[team]))] for team in rosters)
        super().__init__(
            settings.name, rosters, settings.timing, asdict(rules) | {"randomisation": asdict(settings.randomisation)},
            props=walls() if rules.walls else (), solver=Solver(contacts=contacts, rows=ROWS * contacts),
            marker_kinds=_marker_kinds(settings.tanks, settings.drones), **options,
        )  # fmt: skip
        self.rules, self.weights, self.randomisation = rules, settings.reward, settings.randomisation
        self.randomisation.check(self.scene)
        self.observation_builder, self.rich = ObservationBuilder(settings.slots, settings.buffer), settings.rich
        self._bases = {team: np.array([self.scene.agents[name].qpos for name in names]) for team, names in self._names}
        self._rest = jnp.asarray(self.scene.rest, jnp.float32)

    @property
    def _names(self) -> tuple[tuple[str, list[str]], ...]:
        return ("blue", self.tanks), ("red", self.drones)

    def observation_size(self, agent: str) -> int:
        """Return the size of the observation: slots, and a buffer or all about the enemies."""
        return size(
            self.robots[agent].kind, self.observation_builder.slots, self._shown(agent), self.observation_builder.buffer
        )

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the observation."""
        mates = len(self.tanks if agent in self.tanks else self.drones) - 1
        return parts(
            self.robots[agent].kind,
            self.observation_builder.slots,
            mates,
            self._shown(agent),
            self.observation_builder.buffer,
        )

    def _shown(self, agent: str) -> int:
        """Return the number of enemies that an agent fully observes."""
        return len(self.drones if agent in self.tanks else self.tanks) if self.rich else 0

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the terms."""
        rules = self.rules
        late = {
            "draw": "½ each when time is up",
            "tanks": "1 for the tanks when time is up",
            "drones": "1 for the drones when time is up",
        }[rules.timeout]
        return Legend(
            score=f"1 for the drones when {rules.goals} of them reached the goal, 1 for the tanks when too few live for"
            f" that; ½ each for both in one control step; {late}",
            rewards=dict.fromkeys(("hit", "goal", "loss", "time"), ""),
            shapings=dict.fromkeys(("aim", "approach"), ""),
            events={
                "capture": "the tanks hit a drone",
                "crash": "a drone came too low",
                "goal": "a drone reached its goal",
            },
        )

    # Start -----------------------------------------------------------------------------------------------------------

    def place(self, key: Array) -> tuple[Array, Array, GameState]:
        """Place tanks on the ground, and drones level and at rest in the air."""
        rules, keys = self.rules, jax.random.split(key, 6)
        tanks = geometry.sample_lanes(keys[0], rules.tanks_at, len(self.tanks), HULLS["tank"], rules.scatter)
        drones = geometry.sample_lanes(keys[1], rules.drones_at, len(self.drones), HULLS["drone"], rules.scatter)
        tanks = tanks.at[:, 2].add(self.robots[self.tanks[0]].rest_height)
        random, qpos = rules.heading == "random", self._rest
        for (team, _), places, turn in zip(self._names, (tanks, drones), keys[2:4], strict=True):
            heading = geometry.sample_headings(turn, len(places), random)
            qpos = qpos.at[self._bases[team][:, None] + np.arange(7)].set(
                upright_poses(places[:, :2], heading, places[:, 2])
            )
        joints = np.stack([self.scene.agents[name].joint_qpos for name in self.tanks])
        qpos = qpos.at[joints].set(geometry.sample_barrel_angles(keys[4], len(self.tanks), rules.barrel == "random"))
        drawn = jnp.stack(
            [geometry.sample_point(each, rules.goals_at) for each in jax.random.split(keys[5], len(drones))]
        )
        goals = drawn if rules.goal == "point" else self._above(tanks)
        none = jnp.zeros(len(self.drones), bool)
        return qpos, jnp.zeros(self.scene.model.nv), GameState(goals, ~none, none, jnp.zeros(2, bool))

    def randomise(self, key: Array) -> dict[str, Array]:
        """Draw model fields by the settings."""
        return self.randomisation.draw(key, self.scene)

    def alive(self, physics: Physics, game: GameState) -> Array:
        """Return (agents,) bool: all tanks, and the drones that live."""
        return jnp.concatenate([jnp.ones(len(self.tanks), bool), game.alive])

    # Rules -----------------------------------------------------------------------------------------------------------

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Judge the control step: drones that are hit or too low die, living ones near their goals reach them; see the
        table.
        """
        rules, defects, was = self.rules, self.rules.defects, game.alive
        places = self._places("red", physics)
        goals = self._above(self._places("blue", physics)) if rules.goal == "tank" else game.goals
        shot, low = self._hit(physics, places), places[:, 2] <= (-jnp.inf if rules.floor is None else rules.floor)
        alive = ~(shot | low) if defects.revive else was & ~(shot | low)
        near = was & (_length(places - goals) <= rules.goal_radius)  # dead drones cannot arrive
        reached = game.reached | near
        won = jnp.stack([(alive | game.reached).sum() < rules.goals, reached.sum() >= rules.goals])
        died = ~alive if defects.paid_while_dead else was & ~alive
        arrived = near if defects.late_end else near & ~game.reached
        late = physics.time > rules.episode - self.timing.control_interval / 2
        ended = game.pending if defects.late_end else won
        verdict = Verdict(
            rewards=self._rewards(died, arrived, ended),
            shapings=self._hints(before, physics, game, was),
            events={
                "capture": jnp.stack([(was & shot).any(), jnp.zeros((), bool)]),
                "crash": jnp.stack([jnp.zeros((), bool), (was & low).any()]),
                "goal": jnp.stack([jnp.zeros((), bool), near.any()]),
            },
            **self._outcome(ended, late),
        )
        return GameState(goals, alive, reached, won), verdict

    def _hit(self, physics: Physics, drones: Array) -> Array:
        """Return (drones,) bool: drones at (drones, 3) m that any barrel points at, not only its own target."""
        rules = self.rules

        def meets(of: Barrel, drone: Array) -> Array:
            if rules.hit == "ray":
                return geometry.ray_gap(of, drone) <= rules.ray
            gap = geometry.quaternion_gap(from_x(geometry.bearing(of, drone)), from_x(of.ahead))
            return gap < rules.aim_error

        barrels = self._barrels(physics)
        return jnp.stack([jnp.stack([meets(of, drone) for of in barrels]).any() for drone in drones])

    def _outcome(self, won: Array, late: Array) -> dict[str, Array]:
        """Return score, terminated and truncated of a verdict; `won` (teams,) bool, `late` () bool."""
        over, timeout = won.any(), self.rules.timeout
        held = {"draw": (0.5, 0.5), "tanks": (1.0, 0.0), "drones": (0.0, 1.0)}[timeout]
        decided = 0.5 + 0.5 * (1.0 * won - 1.0 * won[::-1])
        expired = late & ~over
        cut = expired if timeout == "draw" else jnp.zeros((), bool)
        return {
            "score": jnp.where(over, decided, jnp.array(held)), "terminated": over | (expired & ~cut), "truncated": cut
        }  # fmt: skip

    def _rewards(self, died: Array, arrived: Array, won: Array) -> dict[str, Array]:
        """Return each term (teams,); `died` and `arrived` (drones,), `won` (teams,) bool."""
        w, zero = self.weights, jnp.zeros(())
        return {
            "hit": jnp.stack([w.hit * died.sum(), zero]),
            "goal": jnp.stack([zero, w.goal * arrived.sum()]),
            "loss": w.loss * (won[::-1] & ~won),
            "time": jnp.full(2, w.time),
        }

    def _hints(self, before: Physics, physics: Physics, game: GameState, alive: Array) -> dict[str, Array]:
        """Return how much nearer barrels and drones came to their targets in this control step; `alive` is from before
        it.
        """
        w, zero = self.weights, jnp.zeros(())
        target = self._targets(alive)

        def off(physics: Physics) -> Array:
            drones = self._places("red", physics)
            pairs = zip(self._barrels(physics), target, strict=True)
            return jnp.stack([geometry.angle(of.ahead, geometry.bearing(of, drones[i])) for of, i in pairs]).mean()

        def far(physics: Physics) -> Array:
            return (alive * _length(self._places("red", physics) - game.goals)).mean()

        return {
            "aim": jnp.stack([w.aim * (off(before) - off(physics)), zero]),
            "approach": jnp.stack([zero, w.approach * (far(before) - far(physics))]),
        }

    def markers(self, physics: Physics, game: GameState) -> dict[str, Array]:
        """Return lasers, goals, and round each living drone the sphere that a laser must pass through."""
        markers: dict[str, Array] = {}
        barrels, drones = self._barrels(physics), self._places("red", physics)
        radius = self.rules.ray if self.rules.hit == "ray" else None
        for k, of in enumerate(barrels):
            markers[f"laser-{k}"] = laser(of)
        for k, drone in enumerate(drones):
            markers[f"goal-{k}"] = jnp.append(game.goals[k], self.rules.goal_radius)
            markers[f"zone-{k}"] = zone(barrels, drone, radius) * jnp.append(jnp.ones(3), game.alive[k])
        return markers

    def _above(self, tanks: Array) -> Array:
        """Return goals (drones, 3) above tanks at (tanks, 3), m: drone k's is above tank k, modulo their number."""
        pair = np.arange(len(self.drones)) % len(self.tanks)
        return tanks[pair] + jnp.array([0.0, 0.0, self.rules.goal_above])

    def _targets(self, alive: Array) -> Array:
        """Return (tanks,) the drone that each tank aims at: that of its index, or the next that lives."""
        drones = len(self.drones)
        own = np.arange(len(self.tanks)) % drones
        if self.rules.defects.revive:
            return jnp.asarray(own)
        turn = (own[:, None] + np.arange(drones)) % drones  # (tanks, drones)
        return jnp.take_along_axis(jnp.asarray(turn), jnp.argmax(alive[turn], axis=1)[:, None], axis=1)[:, 0]

    def _places(self, team: str, physics: Physics) -> Array:
        """Return the positions of a team's bases, (robots, 3) m."""
        return physics.qpos[self._bases[team][:, None] + np.arange(3)]

    def _barrels(self, physics: Physics) -> list[Barrel]:
        bodies = (self.body(name, physics, {name: jnp.zeros(2)}) for name in self.tanks)
        return [barrel(body.pose, body.angles) for body in bodies]

    # Observations and scripts -----------------------------------------------------------------------------------------

    def observe(self, physics: Physics, game: GameState, actions: dict[str, Array]) -> dict[str, Array]:
        """Return observations: targets and goals, and with `rich` all about the enemies."""
        bodies = {name: self.body(name, physics, actions) for name in self.robots}
        proprioception = {name: robot.observe_self(bodies[name]) for name, robot in self.robots.items()}
        drones, target = self._places("red", physics), self._targets(game.alive)
        everyone = [
            Drone(bodies[name].pose[:3], bodies[name].velocity[:3], game.alive[k]) for k, name in enumerate(self.drones)
        ]
        shown, barrels = (everyone, self._barrels(physics)) if self.rich else ([], [])

        def mates(names: list[str], k: int) -> list[Array]:
            return [bodies[name].pose[:3] for name in (*names[k + 1 :], *names[:k])]

        tanks = {
            name: self.observation_builder.tank(
                bodies[name], proprioception[name], drones[target[k]], mates(self.tanks, k), shown
            )
            for k, name in enumerate(self.tanks)
        }
        return tanks | {
            name: self.observation_builder.drone(
                bodies[name], proprioception[name], game.goals[k], mates(self.drones, k), barrels
            )
            for k, name in enumerate(self.drones)
        }

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return a tank that aims, and drones that fly to their goals straight or in a slalom."""
        first, tanks = size("crazyflie", self.observation_builder.slots), len(self.tanks) if self.rich else 0
        ray = self.rules.ray if self.rules.hit == "ray" else 0.0
        return scripts.of_match(self.rules.tank_speed, first, tanks, ray)


def walls() -> tuple[props.Prop, ...]:
    """Make the four walls round soccer's field, 20 x 10 m between their centres, 2 m high."""
    x, y = FIELD[0] + WALL, FIELD[1] + WALL
    return tuple(
        props.wall(name, at=(*at, TALL), half=(*half, TALL))
        for name, at, half in (
            ("wall-north", (0.0, y), (x, WALL)), ("wall-south", (0.0, -y), (x, WALL)),
            ("wall-east", (x, 0.0), (WALL, y)), ("wall-west", (-x, 0.0), (WALL, y)),
        )
    )  # fmt: skip


def drone_robot(floor: float | None) -> Robot:
    """Make a drone that has fallen at this height in metres and below; None: never."""
    return crazyflie(-1.0 if floor is None else floor)


def laser(of: Barrel) -> Array:
    """Return a segment (6,) to draw: along the barrel, to the ground or to the length BEAM."""
    ground = jnp.where(of.ahead[2] < -1e-3, -of.pivot[2] / jnp.minimum(of.ahead[2], -1e-3), BEAM)
    return jnp.concatenate([of.pivot, of.pivot + jnp.clip(ground, 0.0, BEAM) * of.ahead])


def zone(barrels: Sequence[Barrel], point: Array, radius: float | None = None) -> Array:
    """Return a sphere (4,) to draw round a target; a laser that crosses it hits (approximately, for quaternions)."""
    if radius is not None:
        return jnp.append(point, radius)
    return jnp.append(point, TOLERANCE * jnp.stack([_length(point - of.pivot) for of in barrels]).min())


def _marker_kinds(tanks: int, drones: int) -> dict[str, str]:
    lasers = {f"laser-{k}": "segment" for k in range(tanks)}
    goals, zones = {f"goal-{k}": "ball" for k in range(drones)}, {f"zone-{k}": "sphere" for k in range(drones)}
    return lasers | goals | zones


def _length(vectors: Array) -> Array:
    return jnp.sqrt(jnp.sum(vectors**2, axis=-1))
