"""The disturbed walk: a robot walks ahead, and nature pushes its bodies, or sets masses, friction and ground before.

The walk is that of `arenas.games.walk`, with its goal ahead of the start. Nature is the other team:

- `disturbance` pushes bodies of the walker in every decision;
- `designer` sets factors in the first decision, and chooses among height fields, and then leaves the game.

The walker wins at the goal; nature wins when the walker falls, or time is up. Nature's reward is the walker's with the
opposite sign, and a cost of its forces. Without bodies and factors there is no nature: one team, with the same
observation, whose policies play in both.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from arenas.arena_settings import EngineOptions
from arenas.description import Legend, Part
from arenas.errors import ArenaError
from arenas.games.disturbance.settings import BASE, FLAT, FRICTION, NATURE, TERRAIN, DisturbanceSettings
from arenas.games.sumo.walk import WALKER, GameState
from arenas.games.walk.match import RobotWalk, walker_of
from arenas.physics.engine import Physics
from arenas.robots.kinematics import Heights
from arenas.robots.nature import designer, disturbance
from arenas.robots.robot import Body, Robot, Script
from arenas.scene.colours import TEAM_COLOURS
from arenas.scene.height_fields import HeightField, Terrain
from arenas.state import Verdict

GROUND = 0x6772  # folded into an episode's key for its ground
GRAVITY = 9.81  # m/s²
SIDES = jnp.array([1.0, -1.0])  # the walker's gain is nature's loss


class NatureState(NamedTuple):
    """Deeds of nature: the part of the walk's state that this game adds."""

    factors: Array  # (factors,) that the designer set; 1 before
    designing: Array  # () bool: the first decision is still to come
    effort: Array  # () mean square of the present forces, as shares of their limit


class Disturbance(RobotWalk):
    """A walker, `blue/0`, and nature."""

    def __init__(self, settings: DisturbanceSettings, **options: Unpack[EngineOptions]):
        walker = walker_of(settings.blue[0])
        self.bounds, self.axes = settings.bounds, settings.axes
        model = _model(walker)
        self.limit = max(settings.rules.force, settings.rules.weight_share * GRAVITY * float(model.body_mass.sum()))
        bodies = [_body_name(walker, model, "bodies", name) for name in settings.bodies]
        if twice := [name for name in bodies if bodies.count(name) > 1]:
            raise ArenaError(f"bodies: {twice[0].removeprefix(f'{WALKER}/')} is named twice")
        weighed = {
            name: _body_name(walker, model, "design", name) for name in self.bounds if name not in (FRICTION, TERRAIN)
        }
        nature: list[Robot] = []
        if bodies:
            nature.append(disturbance(bodies, self.limit, self.axes))
        if self.bounds:
            nature.append(designer(self.bounds))
        fields = [HeightField.of(name, float(x), settings.rules.distance) for name, x in settings.terrain.items()]
        props = [field.prop() for field in fields]
        super().__init__(settings, {NATURE: nature} if nature else {}, props, **options)
        self.terrain = Terrain(self.scene.model, fields, self.engine.name)
        self._flat = jnp.asarray(self.scene.model.body_pos, jnp.float32)
        self.cost, self._ahead = self.weights.pop("force"), settings.rules.distance
        self.alone = not nature
        self._nature = {robot.kind: agent for agent, robot in self.robots.items() if agent != WALKER}
        numbers = {FLAT: 0} | {field.name: 1 + i for i, field in enumerate(fields)}
        self._factors = [
            _Ground(self.terrain, [numbers[str(each)] for each in bounds])
            if name == TERRAIN
            else _Factor(self.scene.model, self._at.base, weighed.get(name))
            for name, bounds in self.bounds.items()
        ]
        self._before = jnp.array([factor.before for factor in self._factors])

    def observation_size(self, agent: str) -> int:
        """Return the size of the observation: nature sees what the walker sees, and the factors."""
        return self.layout.size + (len(self.bounds) if agent != WALKER else 0)

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the observation."""
        parts = super().observation_parts(WALKER)
        if agent == WALKER:
            return parts
        meaning = {TERRAIN: "the place in nature's choice, from 0; 0 before"}
        factors = (
            Part(f"factor {name}", 1, "", meaning.get(name, "that nature set; 1 before")) for name in self.bounds
        )
        return (*parts, *factors)

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the walker's terms."""
        walk = super().legend()
        if self.alone:
            return walk
        won = f"1 for the walker within {self.rules.reach:g} m of the goal; 1 for nature when it falls, or time is up"
        return Legend(won, {**walk.rewards, "force": ""}, events=walk.events)

    def heights(self, physics: Physics, body: Body) -> Heights:
        """Return the heights of torso, limbs and feet above the ground under the base."""
        low, ground = super().heights(physics, body), self.ground_height(physics, body.pose[:2])
        return low if ground is None else jax.tree.map(lambda height: height - ground, low)

    def ground_height(self, physics: Physics, at: Array) -> Array | None:
        """Return the height () of the height field that is in place, m."""
        return self.terrain.height(physics.model["body_pos"], at) if self.terrain.fields else None

    # Rules -----------------------------------------------------------------------------------------------------------

    def place(self, key: Array) -> tuple[Array, Array, GameState]:
        """Place the walker at the origin, facing the goal, with joints a little off their rest."""
        at, noise = self._at, 0.02 * jax.random.normal(key, (len(self._at.joint_qpos),))
        qpos = self._rest.at[at.joint_qpos].add(noise)
        goal, still = jnp.array([self._ahead, 0.0]), jnp.zeros(self.robot.action_size)
        nature = NatureState(self._before, jnp.ones((), bool), jnp.zeros(()))
        walk = GameState(goal, still, still, jnp.zeros(len(self.robot.feet)), nature)
        return qpos, jnp.zeros(self.scene.model.nv), walk

    def randomise(self, key: Array) -> dict[str, Array]:
        """Draw model fields by the settings, and the ground, and add those that nature may set."""
        drawn, model = super().randomise(key), self.scene.model
        if self.terrain.fields and TERRAIN not in self.bounds:
            number = jax.random.randint(jax.random.fold_in(key, GROUND), (), 0, 1 + len(self.terrain.fields))
            drawn = drawn | {"body_pos": self.terrain.placed(drawn.get("body_pos", self._flat), number)}
        names = {field for factor in self._factors for field in factor.fields}
        return {name: jnp.asarray(getattr(model, name), jnp.float32) for name in sorted(names)} | drawn

    def decide(self, game: GameState, actions: dict[str, Array]) -> GameState:
        """Store the walker's action, nature's effort and, in the first decision, its factors."""
        factors, designing, effort = game.nature
        if pusher := self._nature.get("disturbance"):
            effort = jnp.mean(jnp.clip(actions[pusher], -1.0, 1.0) ** 2)
        if author := self._nature.get("designer"):
            factors = jnp.where(designing, self.robots[author].designed(actions[author]), factors)
        nature = NatureState(factors, jnp.zeros((), bool), effort)
        return super().decide(game, actions)._replace(nature=nature)

    def design(self, physics: Physics, game: GameState) -> tuple[Array, Array, dict[str, Array]] | None:
        """Multiply friction and masses by nature's factors, and put the chosen ground in place."""
        if not self._factors:
            return None
        fields = dict(physics.model)
        for factor, value in zip(self._factors, game.nature.factors, strict=True):
            fields |= {name: factor.applied(fields[name], value) for name in factor.fields}
        return physics.qpos, physics.qvel, {name: fields[name] for f in self._factors for name in f.fields}

    def observe(self, physics: Physics, game: GameState, actions: dict[str, Array]) -> dict[str, Array]:
        """Return the walk's observation, for nature with the factors."""
        seen = super().observe(physics, game, actions)[WALKER]
        nature = jnp.concatenate([seen, game.nature.factors])
        return {agent: seen if agent == WALKER else nature for agent in self.robots}

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Judge the walk, and give nature the opposite."""
        game, verdict = super().judge(before, physics, game)
        if self.alone:
            return game, verdict
        rewards = {name: term * SIDES for name, term in verdict.rewards.items()}
        rewards["force"] = self.cost * self.timing.control_interval * game.nature.effort * jnp.array([0.0, 1.0])
        return game, verdict._replace(
            rewards=rewards,
            score=jnp.concatenate([verdict.score, 1.0 - verdict.score]),
            events={name: jnp.append(event, False) for name, event in verdict.events.items()},
        )

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return the walk's scripts, and where nature pushes `headwind`, a constant force against the walk with the
        factors in the middle.
        """
        if not self._pushed:
            return super().game_scripts()
        wind = jnp.tile(jnp.array([-1.0 if axis == "x" else 0.0 for axis in self.axes]), self._pushed)
        still = jnp.zeros(len(self.bounds))
        nature: Mapping[str, Script] = {"disturbance": lambda seen, key: wind, "designer": lambda seen, key: still}
        return {**super().game_scripts(), "headwind": nature}

    @property
    def _pushed(self) -> int:
        """The number of bodies that nature pushes."""
        push = self.robots[self._nature["disturbance"]].push if "disturbance" in self._nature else None
        return len(push.bodies) if push else 0


class DesignedDisturbance(Disturbance):
    """The same with a designer, which leaves the game after its first decision."""

    def alive(self, physics: Physics, game: GameState) -> Array:
        """Return (agents,) bool: all, and the designer until its first decision."""
        return jnp.stack([
            game.nature.designing if robot.kind == "designer" else jnp.ones((), bool) for robot in self.robots.values()
        ])  # fmt: skip


class _Factor:
    """One number that nature sets: a factor on the walker's friction, or on the mass of one of its bodies."""

    before = 1.0  # of the first decision

    def __init__(self, model: mujoco.MjModel, base: int, body: str | None):
        """Choose a body by its name in the model, or without one the friction of the robot with this base (id)."""
        if body is None:
            self.fields: tuple[str, ...] = ("geom_friction",)
            self._chosen = np.zeros((model.ngeom, 3), bool)
            self._chosen[model.body_rootid[model.geom_bodyid] == base, 0] = True
        else:
            self.fields = ("body_mass", "body_inertia")
            self._chosen = np.arange(model.nbody) == model.body(body).id

    def applied(self, field: Array, factor: Array) -> Array:
        """Return a field of the model with its own numbers multiplied."""
        chosen = self._chosen if field.ndim == self._chosen.ndim else self._chosen[:, None]
        return jnp.where(chosen, field * factor, field)


class _Ground:
    """Another number that nature sets: the place in its choice of ground, 0 before."""

    fields, before = ("body_pos",), 0.0

    def __init__(self, terrain: Terrain, numbers: Sequence[int]):
        """Choose among fields by their numbers in the scene's terrain."""
        self._terrain, self._numbers = terrain, jnp.array(numbers)

    def applied(self, field: Array, place: Array) -> Array:
        """Return the places of bodies with the chosen field alone on the ground."""
        return self._terrain.placed(field, self._numbers[place.astype(int)])


def _model(robot: Robot) -> mujoco.MjModel:
    """Compile a robot alone."""
    assert robot.build is not None
    return robot.build(TEAM_COLOURS[0]).compile()


def _body_name(robot: Robot, model: mujoco.MjModel, setting: str, name: str) -> str:
    """Return the name in the scene of a body of the walker. Raises ArenaError, one line, if it has no such body."""
    known = [model.body(i).name for i in range(1, model.nbody)]
    body = robot.base if name == BASE else name
    if body not in known:
        raise ArenaError(f"{setting}: {robot.kind} has no body {name}; it has {', '.join(known)}")
    return f"{WALKER}/{body}"
