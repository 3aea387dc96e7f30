"""The contract of every arena: two operations, `reset` and `step`, around the hooks that a game implements.

Functions handle one world: callers batch with `jax.vmap` and write `jax.lax.scan` themselves. A step is one *decision*:
the actions are held for `hold` control steps, each of `substeps` physics timesteps, and the game is judged after every
control step. The first verdict of a game is final: later control steps of the same decision change nothing.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, Unpack, final

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena_settings import EngineOptions
from arenas.errors import ArenaError
from arenas.game import Game
from arenas.physics.engine import Physics, StepResult, cause_bit, is_finite, keep_apart_from_fusion, no_cause
from arenas.physics.float_products import full_float32
from arenas.physics.void_causes import Cause
from arenas.scene.starts import draw_where
from arenas.state import (
    Frames,
    State,
    Verdict,
    begin_decision,
    finite_observations,
    masked_verdict,
    merge_verdicts,
    undecided_verdict,
)

STORED_NAMES = {"at_fault": "culprits"}  # names in checkpoints of fields of State that were renamed since
MODEL_FIELDS = 0x6D6F6465  # folded into an episode's key for its model fields, far from the keys that games derive


class Arena(Game):
    """A game that can be reset and stepped. It has physics where its robots have bodies."""

    def __init_subclass__(cls) -> None:
        """Raise ArenaError if a game accidentally overrides a private function of the contract."""
        contract = [name for name in (*vars(Game), *vars(Arena)) if name.startswith("_")]
        own = {name for name in contract if not name.startswith(("__", "_abc_"))}
        for name in sorted(own & set(vars(cls))):
            raise ArenaError(f"{cls.__name__}.{name}: the contract of arenas uses this name: choose another")

    @final
    @full_float32
    def reset(self, key: Array) -> State:
        """Return a new world."""
        qpos, qvel, game, fields = self._draw(key)
        return self._begin(self.engine.make(qpos, qvel, fields), game)

    @final
    @full_float32
    def restart(self, state: State, key: Array, where: Array) -> State:
        """Return the same world, reset where `where` () bool; elsewhere unchanged."""
        qpos, qvel, game, fields = draw_where(self._draw, key, where)
        fresh = self._begin(self.engine.place(state.physics, qpos, qvel, where, fields), game)
        # place() already selected world by world. Selecting the engine's own buffers again would cost time and change
        # nothing.
        chosen = jax.tree.map(
            lambda new, old: jnp.where(where, new, old), fresh._replace(physics=()), state._replace(physics=())
        )
        return chosen._replace(physics=fresh.physics)

    @final
    def step(self, state: State, actions: dict[str, Array]) -> State:
        """Take one decision. Stepping a world that is done continues the simulation but changes no verdict."""
        return self.step_with_frames(state, actions)[0]

    @final
    @full_float32
    def step_with_frames(self, state: State, actions: dict[str, Array]) -> tuple[State, Frames]:
        """Take one decision, and return the frames for a recording too. Non-finite actions make an undecided world
        void.
        """
        actions = self._executed_actions(actions, state.alive)
        frame_command = self.command(actions)
        non_finite = self._non_finite_actions(actions)

        def control_step(
            carry: tuple[Physics, Any, Verdict, Array, Array, Array], result: StepResult | None
        ) -> tuple[Any, Frames]:
            before, game, verdict, void, at_fault, causes = carry
            command = frame_command
            if self._agents_can_leave:
                executed = self._executed_actions(actions, self.alive(before, game))
                command, before = self.command(executed), before._replace(push=self.push(executed))
            physics = self.engine.step(before, command, self.timing.substeps, self.law, result)
            decided = verdict.terminated | verdict.truncated | void
            game_after, news = self.judge(before, physics, game)
            wrong = physics.causes | cause_bit(non_finite.any(), Cause.ACTIONS)
            broken = ~decided & (wrong != 0)
            news = masked_verdict(news, ~(decided | broken))
            at_fault = jnp.where(broken, self._teams_at_fault(physics, non_finite), at_fault)
            causes = jnp.where(broken, wrong, causes)
            game = jax.tree.map(lambda old, new: jnp.where(decided, old, new), game, game_after)
            (qpos,) = keep_apart_from_fusion(physics.qpos)
            over = decided | broken | news.terminated | news.truncated
            terms = news.rewards, news.shapings, news.events
            frames = Frames(qpos, physics.time, self.drawn_markers(physics, game), *terms, over)
            return (physics, game, merge_verdicts(verdict, news), void | broken, at_fault, causes), frames

        first = begin_decision(state.verdict)
        game = jax.tree.map(
            lambda old, new: jnp.where(state.done, old, new), state.game, self.decide(state.game, actions)
        )
        pushed = self._designed(state, game)._replace(push=self.push(actions))
        carry = (pushed, game, first, state.void, state.at_fault, state.causes)
        carry, frames = jax.lax.scan(control_step, carry, self._step_many(pushed, frame_command), self.timing.hold)
        physics, game, verdict, void, at_fault, causes = carry
        alive, observations = self._alive_and_observations(physics, game, actions)
        return State(physics, game, observations, actions, verdict, void, at_fault, alive, causes), frames

    @final
    def rest_if_done(self, state: State) -> State:
        """Let a world that is done stay where it is in the next step, on engines that can leave it out (`c`)."""
        return state._replace(physics=self.engine.rest(state.physics, state.done))

    @final
    @full_float32
    def privileged_state(self, state: State) -> Array:
        """Return `privileged` of a world, (privileged_size,), with non-finite and huge values removed for networks."""
        found = finite_observations({"state": self.privileged(state.physics, state.game, state.actions)})
        return keep_apart_from_fusion(found["state"])[0]

    @final
    @full_float32
    def save(self, state: State) -> dict[str, Array]:
        """Return everything that decides how this world continues, as named arrays; batch with `jax.vmap`."""
        leaves = jax.tree_util.tree_leaves_with_path(self._with_saved_physics(state))
        return {_path(path): _data(leaf) for path, leaf in leaves}

    @final
    @full_float32
    def load(self, saved: Mapping[str, Array]) -> State:
        """Restore the world of `save`, which continues bit for bit on the same engine."""
        example = jax.eval_shape(lambda key: self._with_saved_physics(self.reset(key)), jax.random.key(0))
        leaves, structure = jax.tree_util.tree_flatten_with_path(example)
        missing = {_path(path) for path, _ in leaves} ^ set(saved)
        if missing:
            raise ArenaError(f"these are not worlds of {self.name}: {', '.join(sorted(missing))} missing or unknown")
        state = jax.tree.unflatten(structure, [_typed(saved[_path(path)], leaf) for path, leaf in leaves])
        return state._replace(physics=self.engine.load(state.physics))

    # Inside ----------------------------------------------------------------------------------------------------------

    def _draw(self, key: Array) -> tuple[Array, Array, Any, dict[str, Array]]:
        """Draw the start of an episode with `place` and `randomise`."""
        return *self.place(key), self.randomise(jax.random.fold_in(key, MODEL_FIELDS))

    def _begin(self, physics: Physics, game: Any) -> State:
        actions = {a.name: jnp.zeros(a.action_size) for a in self.agents}
        alive, observations = self._alive_and_observations(physics, game, actions)
        bare = physics._replace(carry=())
        verdict = undecided_verdict(jax.eval_shape(self.judge, bare, bare, game)[1])
        teams = jnp.zeros(len(self.teams), bool)
        return State(physics, game, observations, actions, verdict, jnp.zeros((), bool), teams, alive, no_cause())

    def _designed(self, state: State, game: Any) -> Physics:
        """Return the physics at the start of a decision, which in the first one are those of `design`."""
        design = self.design(state.physics, game)
        if design is None:
            return state.physics
        qpos, qvel, fields = design
        if unknown := set(fields) - set(state.physics.model):
            raise ArenaError(f"design sets {', '.join(sorted(unknown))}: return the model's values in randomise too")
        first = (state.physics.time == 0.0) & ~state.done
        return self.engine.place(state.physics, qpos, qvel, first, fields)

    def _step_many(self, physics: Physics, command: Array) -> StepResult | None:
        """Return all control steps of a decision, stacked, if the engine can compute them before the game judges the
        first.

        None where agents can leave the game: an agent's command changes when it leaves between two control steps.
        """
        if self._agents_can_leave:
            return None
        return self.engine.step_many(physics, command, self.timing.substeps, self.law, self.timing.hold)

    def _executed_actions(self, actions: dict[str, Array], alive: Array) -> dict[str, Array]:
        """Return the actions (act,) to execute: the given ones of agents that are `alive` (agents,), else `limp`."""
        if not self._agents_can_leave:
            return actions
        limp = {a: jnp.array(robot.limp or [0.0] * robot.action_size) for a, robot in self.robots.items()}
        return {a: jnp.where(on, actions[a], limp[a]) for a, on in zip(self.robots, alive, strict=True)}

    def _alive_and_observations(
        self, physics: Physics, game: Any, actions: dict[str, Array]
    ) -> tuple[Array, dict[str, Array]]:
        """Return `alive` (agents,) bool and each agent's observation, which is zeros for an agent that is not alive."""
        alive, observations = self.alive(physics, game), finite_observations(self.observe(physics, game, actions))
        if not self._agents_can_leave:
            return alive, observations
        return alive, {a: jnp.where(on, observations[a], 0.0) for a, on in zip(self.robots, alive, strict=True)}

    def _with_saved_physics(self, state: State) -> State:
        """Return the state with the engine's saved form in place of its physics."""
        return state._replace(physics=self.engine.save(state.physics))

    def _non_finite_actions(self, actions: dict[str, Array]) -> Array:
        """Return (teams,) bool: the teams with an agent whose action is not finite."""
        return jnp.stack([
            jnp.stack([~jnp.all(jnp.isfinite(actions[agent])) for agent in agents]).any()
            for agents in self._rosters.values()
        ])  # fmt: skip

    def _teams_at_fault(self, physics: Physics, non_finite: Array) -> Array:
        """Return (teams,) bool: the teams that caused the non-finite numbers of a world that becomes void now.

        Non-finite actions decide this. Otherwise the robots' numbers do, if those of one team alone are not finite. An
        overflow of a contact buffer identifies no team.
        """
        bad = jnp.stack([
            ~jnp.stack([self._agent_is_finite(agent, physics) for agent in agents]).all()
            for agents in self._rosters.values()
        ])  # fmt: skip
        alone = bad if len(self._rosters) == 1 else bad & ~bad.all()
        return jnp.where(non_finite.any(), non_finite, alone)

    def _agent_is_finite(self, agent: str, physics: Physics) -> Array:
        at = self.scene.agents.get(agent)
        return is_finite(physics.qpos[at.own_qpos], physics.qvel[at.own_qvel]) if at else jnp.ones((), bool)


def _path(path: tuple) -> str:
    """Return the name under which checkpoints store a leaf of a State."""
    name = jax.tree_util.keystr(path, simple=True, separator="/")
    return STORED_NAMES.get(name, name)


def _data(leaf: Array) -> Array:
    """Return a leaf as plain numbers; of a random key its key data."""
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


def _typed(values: Array, like: jax.ShapeDtypeStruct) -> Array:
    """Convert saved numbers to the type of the leaf `like`."""
    if jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(values)
    return jnp.asarray(values, like.dtype)


class Settings(Protocol):
    """Settings of an arena: a frozen dataclass of plain values that can build it.

    By convention a field `rules`, also a frozen dataclass, holds everything that decides a game. The contract's checks
    then test that each of its fields changes the configuration hash.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def name(self) -> str:
        """The arena's name, e.g. `sumo-2v2`."""
        ...

    def build(self, **options: Unpack[EngineOptions]) -> Arena:
        """Build the arena."""
        ...
