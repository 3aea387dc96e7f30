"""3D Galaga: tanks, the team blue, aim; drones, the team red, fly to their goals. Who is hit first has not arrived.

| a game ends when                                                   | who wins                                   |
|--------------------------------------------------------------------|--------------------------------------------|
| `goals` drones have reached their goals                            | the drones                                 |
| too few drones live or have arrived for that                       | the tanks                                  |
| both in one control step                                           | a draw                                     |
| no time left                                                       | a draw that is cut off, or as `timeout` says |

A drone is dead when it is hit, or at the `floor` or below. It stays dead and is out of the game: its motors stop, it
cannot be hit again, reach its goal or be paid for. A tank whose drone is dead is shown the next that lives.

One tank and one drone (HARL-A's `main`) or two of each within walls (the paper's) are settings of one game, as is any
other number. What robots see is `sight.py`, where they start and what a barrel hits `geometry.py`, their scripts
`scripts.py`. `docs/arenas/galaga.md` says why each setting is what it is.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas import props
from arenas.about import Legend, Part
from arenas.arena import Arena
from arenas.galaga import geometry, scripts
from arenas.galaga.geometry import Barrel, barrel
from arenas.galaga.layouts import parts, size
from arenas.galaga.settings import FIELD, HULLS, GalagaSettings
from arenas.galaga.sight import Drone, Sight
from arenas.options import Solver, Where
from arenas.physics import Physics
from arenas.robots.crazyflie import crazyflie
from arenas.robots.minitank import from_x, minitank
from arenas.robots.robot import Robot, Script
from arenas.starts import bases
from arenas.state import Verdict

WALL, TALL = 0.25, 1.0  # m, half a wall's thickness and height
BEAM = 12.0  # m of the laser that are drawn
TOLERANCE = 0.07  # rad, about what `aim_error` = 0.05 allows: the sphere drawn round a drone
# Warp's slots for each robot, and rows for each slot. Random play that began in a corner, by a wall, used at most 18 of
# 32 contacts and 74 of 128 rows in the game of two, and 8 of 16 and 33 of 64 on an open plane.
CONTACTS, ROWS = {"minitank": 8, "crazyflie": 8}, 4


class Game(NamedTuple):
    """What a game is about beside the robots' places."""

    goals: Array  # (drones, 3) m in the world
    alive: Array  # (drones,) bool
    reached: Array  # (drones,) bool: who has been at its goal
    pending: Array  # (teams,) bool: who had won in the control step before; for `late_end` alone


class Galaga(Arena):
    """Blue tanks against red drones, as many as the settings say."""

    def __init__(self, settings: GalagaSettings, **where: Unpack[Where]):
        rules = settings.rules
        drone = floored(rules.floor)
        if rules.defects.drift:
            drone = replace(drone, limp=())
        rosters = {"blue": [minitank(rules.tank_speed)] * settings.tanks, "red": [drone] * settings.drones}
        contacts = sum(CONTACTS[robot.kind] for team in rosters.values() for robot in team)
        self.tanks, self.drones = ([f"{team}/{i}" for i in range(len(rosters[team]))] for team in rosters)
        super().__init__(
            settings.name, rosters, settings.timing, asdict(rules) | {"randomisation": asdict(settings.randomisation)},
            props=walls() if rules.walls else (), solver=Solver(contacts=contacts, rows=ROWS * contacts),
            marker_kinds=_marker_kinds(settings.tanks, settings.drones), **where,
        )  # fmt: skip
        self.rules, self.weights, self.randomisation = rules, settings.reward, settings.randomisation
        self.randomisation.check(self.scene)
        self.sight, self.rich = Sight(settings.slots, settings.buffer), settings.rich
        self._bases = {team: np.array([self.scene.agents[name].qpos for name in names]) for team, names in self._names}
        self._rest = jnp.asarray(self.scene.rest, jnp.float32)

    @property
    def _names(self) -> tuple[tuple[str, list[str]], ...]:
        return ("blue", self.tanks), ("red", self.drones)

    def observation_size(self, agent: str) -> int:
        """Slots, and behind them a buffer or all about the enemies."""
        return size(self.robots[agent].kind, self.sight.slots, self._shown(agent), self.sight.buffer)

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """The same in words."""
        mates = len(self.tanks if agent in self.tanks else self.drones) - 1
        return parts(self.robots[agent].kind, self.sight.slots, mates, self._shown(agent), self.sight.buffer)

    def _shown(self, agent: str) -> int:
        """Enemies of whom an agent sees all."""
        return len(self.drones if agent in self.tanks else self.tanks) if self.rich else 0

    def legend(self) -> Legend:
        """Each weight says what its term is."""
        rules = self.rules
        late = {
            "draw": "½ each when time is up",
            "tanks": "1 for the tanks when time is up",
            "drones": "1 for the drones when time is up",
        }[rules.timeout]
        return Legend(
            score=f"1 for the drones when {rules.goals} of them reached the goal, 1 for the tanks when that is out of"
            f" reach, for too few live; ½ each for both in one control step; {late}",
            rewards=dict.fromkeys(("hit", "goal", "loss", "time"), ""),
            shapings=dict.fromkeys(("aim", "approach"), ""),
            events={
                "capture": "the tanks hit a drone",
                "crash": "a drone came too low",
                "goal": "a drone reached its goal",
            },
        )

    # Start -----------------------------------------------------------------------------------------------------------

    def place(self, key: Array) -> tuple[Array, Array, Game]:
        """Tanks on the ground, drones level and at rest in the air."""
        rules, keys = self.rules, jax.random.split(key, 6)
        tanks = geometry.lanes(keys[0], rules.tanks_at, len(self.tanks), HULLS["tank"], rules.scatter)
        drones = geometry.lanes(keys[1], rules.drones_at, len(self.drones), HULLS["drone"], rules.scatter)
        tanks = tanks.at[:, 2].add(self.robots[self.tanks[0]].rest_height)
        random, qpos = rules.heading == "random", self._rest
        for (team, _), places, turn in zip(self._names, (tanks, drones), keys[2:4], strict=True):
            heading = geometry.turned(turn, len(places), random)
            qpos = qpos.at[self._bases[team][:, None] + np.arange(7)].set(bases(places[:, :2], heading, places[:, 2]))
        joints = np.stack([self.scene.agents[name].joint_qpos for name in self.tanks])
        qpos = qpos.at[joints].set(geometry.barrels(keys[4], len(self.tanks), rules.barrel == "random"))
        drawn = jnp.stack([geometry.anywhere(each, rules.goals_at) for each in jax.random.split(keys[5], len(drones))])
        goals = drawn if rules.goal == "point" else self._above(tanks)
        none = jnp.zeros(len(self.drones), bool)
        return qpos, jnp.zeros(self.scene.model.nv), Game(goals, ~none, none, jnp.zeros(2, bool))

    def randomise(self, key: Array) -> dict[str, Array]:
        """As the settings say."""
        return self.randomisation.draw(key, self.scene)

    def alive(self, physics: Physics, game: Game) -> Array:
        """Tanks always, drones while they live."""
        return jnp.concatenate([jnp.ones(len(self.tanks), bool), game.alive])

    # Rules -----------------------------------------------------------------------------------------------------------

    def judge(self, before: Physics, physics: Physics, game: Game) -> tuple[Game, Verdict]:
        """Who is hit or too low dies, who lives and is near enough has reached its goal; too few left, or enough."""
        rules, defects, was = self.rules, self.rules.defects, game.alive
        places = self._places("red", physics)
        goals = self._above(self._places("blue", physics)) if rules.goal == "tank" else game.goals
        shot, low = self._hit(physics, places), places[:, 2] <= (-jnp.inf if rules.floor is None else rules.floor)
        alive = ~(shot | low) if defects.revive else was & ~(shot | low)
        near = was & (_length(places - goals) <= rules.goal_radius)  # the dead cannot arrive
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
        return Game(goals, alive, reached, won), verdict

    def _hit(self, physics: Physics, drones: Array) -> Array:
        """(drones,) bool: at whom a barrel points, whoever's target it is. Drones are at (drones, 3) m."""
        rules = self.rules

        def meets(of: Barrel, drone: Array) -> Array:
            if rules.hit == "ray":
                return geometry.ray_gap(of, drone) <= rules.ray
            gap = geometry.quaternion_gap(from_x(geometry.bearing(of, drone)), from_x(of.ahead))
            return gap < rules.aim_error

        barrels = self._barrels(physics)
        return jnp.stack([jnp.stack([meets(of, drone) for of in barrels]).any() for drone in drones])

    def _outcome(self, won: Array, late: Array) -> dict[str, Array]:
        """Score, terminated and truncated of a verdict, where each team has `won` (teams,), and whether it is late."""
        over, timeout = won.any(), self.rules.timeout
        held = {"draw": (0.5, 0.5), "tanks": (1.0, 0.0), "drones": (0.0, 1.0)}[timeout]
        decided = 0.5 + 0.5 * (1.0 * won - 1.0 * won[::-1])
        expired = late & ~over
        cut = expired if timeout == "draw" else jnp.zeros((), bool)
        return {
            "score": jnp.where(over, decided, jnp.array(held)), "terminated": over | (expired & ~cut), "truncated": cut
        }  # fmt: skip

    def _rewards(self, died: Array, arrived: Array, won: Array) -> dict[str, Array]:
        """Each term (teams,); `died` and `arrived` (drones,), `won` (teams,) bool."""
        w, zero = self.weights, jnp.zeros(())
        return {
            "hit": jnp.stack([w.hit * died.sum(), zero]),
            "goal": jnp.stack([zero, w.goal * arrived.sum()]),
            "loss": w.loss * (won[::-1] & ~won),
            "time": jnp.full(2, w.time),
        }

    def _hints(self, before: Physics, physics: Physics, game: Game, alive: Array) -> dict[str, Array]:
        """What barrels and drones gained towards where they want to be, where a control step before that was."""
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

    def markers(self, physics: Physics, game: Game) -> dict[str, Array]:
        """Lasers, goals, and round each drone that lives what a laser must pass through."""
        seen: dict[str, Array] = {}
        barrels, drones = self._barrels(physics), self._places("red", physics)
        radius = self.rules.ray if self.rules.hit == "ray" else None
        for k, of in enumerate(barrels):
            seen[f"laser-{k}"] = laser(of)
        for k, drone in enumerate(drones):
            seen[f"goal-{k}"] = jnp.append(game.goals[k], self.rules.goal_radius)
            seen[f"zone-{k}"] = zone(barrels, drone, radius) * jnp.append(jnp.ones(3), game.alive[k])
        return seen

    def _above(self, tanks: Array) -> Array:
        """Goals (drones, 3) above tanks at (tanks, 3), m: drone k's is above tank k, modulo their number."""
        pair = np.arange(len(self.drones)) % len(self.tanks)
        return tanks[pair] + jnp.array([0.0, 0.0, self.rules.goal_above])

    def _targets(self, alive: Array) -> Array:
        """(tanks,) which drone each tank aims at: that of its number, or the next that lives."""
        drones = len(self.drones)
        own = np.arange(len(self.tanks)) % drones
        if self.rules.defects.revive:
            return jnp.asarray(own)
        turn = (own[:, None] + np.arange(drones)) % drones  # (tanks, drones)
        return jnp.take_along_axis(jnp.asarray(turn), jnp.argmax(alive[turn], axis=1)[:, None], axis=1)[:, 0]

    def _places(self, team: str, physics: Physics) -> Array:
        """Where a team's bases are, (robots, 3) m."""
        return physics.qpos[self._bases[team][:, None] + np.arange(3)]

    def _barrels(self, physics: Physics) -> list[Barrel]:
        bodies = (self.body(name, physics, {name: jnp.zeros(2)}) for name in self.tanks)
        return [barrel(body.pose, body.angles) for body in bodies]

    # What robots see, and scripts ------------------------------------------------------------------------------------

    def observe(self, physics: Physics, game: Game, actions: dict[str, Array]) -> dict[str, Array]:
        """Targets and goals, and with `rich` all about the enemies."""
        bodies = {name: self.body(name, physics, actions) for name in self.robots}
        felt = {name: robot.feels(bodies[name]) for name, robot in self.robots.items()}
        drones, target = self._places("red", physics), self._targets(game.alive)
        everyone = [
            Drone(bodies[name].pose[:3], bodies[name].velocity[:3], game.alive[k]) for k, name in enumerate(self.drones)
        ]
        shown, barrels = (everyone, self._barrels(physics)) if self.rich else ([], [])

        def mates(names: list[str], k: int) -> list[Array]:
            return [bodies[name].pose[:3] for name in (*names[k + 1 :], *names[:k])]

        tanks = {
            name: self.sight.tank(bodies[name], felt[name], drones[target[k]], mates(self.tanks, k), shown)
            for k, name in enumerate(self.tanks)
        }
        return tanks | {
            name: self.sight.drone(bodies[name], felt[name], game.goals[k], mates(self.drones, k), barrels)
            for k, name in enumerate(self.drones)
        }

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """A tank that aims, drones that fly to their goals straight or aside."""
        tanks = len(self.tanks) if self.rich else 0
        return scripts.of_match(self.rules.tank_speed, tanks, self.rules.ray if self.rules.hit == "ray" else 0.0)


def walls() -> tuple[props.Prop, ...]:
    """The four walls round soccer's field, 20 x 10 m between their centres, 2 m high."""
    x, y = FIELD[0] + WALL, FIELD[1] + WALL
    return tuple(
        props.wall(name, at=(*at, TALL), half=(*half, TALL))
        for name, at, half in (
            ("wall-north", (0.0, y), (x, WALL)), ("wall-south", (0.0, -y), (x, WALL)),
            ("wall-east", (x, 0.0), (WALL, y)), ("wall-west", (-x, 0.0), (WALL, y)),
        )
    )  # fmt: skip


def floored(floor: float | None) -> Robot:
    """A drone that has fallen at this height in metres and below; none: never."""
    return crazyflie(-1.0 if floor is None else floor)


def laser(of: Barrel) -> Array:
    """A segment (6,) to draw: along the barrel, as far as the ground or some metres."""
    ground = jnp.where(of.ahead[2] < -1e-3, -of.pivot[2] / jnp.minimum(of.ahead[2], -1e-3), BEAM)
    return jnp.concatenate([of.pivot, of.pivot + jnp.clip(ground, 0.0, BEAM) * of.ahead])


def zone(barrels: Sequence[Barrel], point: Array, radius: float | None = None) -> Array:
    """A sphere (4,) to draw round what is aimed at, which a laser that hits it crosses: about, for quaternions."""
    if radius is not None:
        return jnp.append(point, radius)
    return jnp.append(point, TOLERANCE * jnp.stack([_length(point - of.pivot) for of in barrels]).min())


def _marker_kinds(tanks: int, drones: int) -> dict[str, str]:
    lasers = {f"laser-{k}": "segment" for k in range(tanks)}
    goals, zones = {f"goal-{k}": "ball" for k in range(drones)}, {f"zone-{k}": "sphere" for k in range(drones)}
    return lasers | goals | zones


def _length(vectors: Array) -> Array:
    return jnp.sqrt(jnp.sum(vectors**2, axis=-1))
