"""The contract of every arena: two verbs, `reset` and `step`, round the hooks that a game fills in.

One world at a time: callers batch with `jax.vmap` and write `jax.lax.scan` themselves. A step is one *decision*: the
actions are held for `hold` control steps, each of `substeps` physics timesteps, and the game is judged after every
control step. What a game decided first stays: later control steps of the same decision change nothing.
"""

from collections.abc import Mapping
from typing import Any, final

import jax
import jax.numpy as jnp
from jax import Array

from arenas.errors import ArenaError
from arenas.game import Game
from arenas.physics import Moved, Physics, sound, stackable
from arenas.starts import drawn
from arenas.state import Frames, State, Verdict, begun, counted, finite, merged, undecided

MODEL_FIELDS = 0x6D6F6465  # folded into an episode's key for its model fields, far from what games split off it


class Arena(Game):
    """A game that can be begun and stepped; one that has physics where its robots have bodies."""

    def __init_subclass__(cls) -> None:
        """Raise ArenaError for a game that by chance has a function of the name of one of the contract's own."""
        contract = [name for name in (*vars(Game), *vars(Arena)) if name.startswith("_")]
        own = {name for name in contract if not name.startswith(("__", "_abc_"))}
        for name in sorted(own & set(vars(cls))):
            raise ArenaError(f"{cls.__name__}.{name}: every arena has something of this name: choose another")

    @final
    def reset(self, key: Array) -> State:
        """A fresh world."""
        qpos, qvel, game, fields = self._draw(key)
        return self._begin(self.engine.make(qpos, qvel, fields), game)

    @final
    def restart(self, state: State, key: Array, where: Array) -> State:
        """The same world, begun anew where `where` () bool; elsewhere it stays as it is."""
        qpos, qvel, game, fields = drawn(self._draw, key, where)
        fresh = self._begin(self.engine.place(state.physics, qpos, qvel, where, fields), game)
        # place() already chose world by world; to compare engines' own buffers again would cost and gain nothing.
        chosen = jax.tree.map(
            lambda new, old: jnp.where(where, new, old), fresh._replace(physics=()), state._replace(physics=())
        )
        return chosen._replace(physics=fresh.physics)

    @final
    def step(self, state: State, actions: dict[str, Array]) -> State:
        """One decision. Stepping a world that is done goes on simulating but changes no verdict."""
        return self.step_with_frames(state, actions)[0]

    @final
    def step_with_frames(self, state: State, actions: dict[str, Array]) -> tuple[State, Frames]:
        """`step`, with what a recording keeps. An action that is not finite makes an undecided world void."""
        actions = self._of_the_living(actions, state.alive)
        whole = self.command(actions)
        wild = self._wild(actions)

        def control_step(carry: tuple[Physics, Any, Verdict, Array, Array], moved: Moved | None) -> tuple[Any, Frames]:
            before, game, verdict, void, culprits = carry
            command = self.command(self._of_the_living(actions, self.alive(before, game))) if self._mortal else whole
            physics = self.engine.step(before, command, self.timing.substeps, self.law, moved)
            decided = verdict.terminated | verdict.truncated | void
            game_after, news = self.judge(before, physics, game)
            broken = ~decided & (physics.unstable | wild.any())
            news = counted(news, ~(decided | broken))
            culprits = jnp.where(broken, self._culprits(physics, wild), culprits)
            game = jax.tree.map(lambda old, new: jnp.where(decided, old, new), game, game_after)
            (qpos,) = stackable(physics.qpos)
            frames = Frames(qpos, physics.time, self.markers(physics, game), news.rewards, news.shapings, news.events)
            return (physics, game, merged(verdict, news), void | broken, culprits), frames

        first = begun(state.verdict)
        game = jax.tree.map(
            lambda old, new: jnp.where(state.done, old, new), state.game, self.decide(state.game, actions)
        )
        carry = (state.physics, game, first, state.void, state.culprits)
        carry, frames = jax.lax.scan(control_step, carry, self._ahead(state.physics, whole), self.timing.hold)
        physics, game, verdict, void, culprits = carry
        alive, observations = self._look(physics, game, actions)
        return State(physics, game, observations, actions, verdict, void, culprits, alive), frames

    @final
    def whole(self, state: State) -> Array:
        """What `privileged` says of a world (privileged_size,), with no number that a network must not see."""
        told = finite({"whole": self.privileged(state.physics, state.game, state.actions)})
        return stackable(told["whole"])[0]

    @final
    def save(self, state: State) -> dict[str, Array]:
        """All that decides how this world goes on, as named arrays; batch with `jax.vmap`."""
        leaves = jax.tree_util.tree_leaves_with_path(self._neutral(state))
        return {_path(path): _data(leaf) for path, leaf in leaves}

    @final
    def load(self, saved: Mapping[str, Array]) -> State:
        """The world of `save`: on the same engine it goes on bit for bit."""
        example = jax.eval_shape(lambda key: self._neutral(self.reset(key)), jax.random.key(0))
        leaves, structure = jax.tree_util.tree_flatten_with_path(example)
        missing = {_path(path) for path, _ in leaves} ^ set(saved)
        if missing:
            raise ArenaError(f"these are no worlds of {self.name}: {', '.join(sorted(missing))} missing or unknown")
        state = jax.tree.unflatten(structure, [_typed(saved[_path(path)], leaf) for path, leaf in leaves])
        return state._replace(physics=self.engine.load(state.physics))

    # Inside ----------------------------------------------------------------------------------------------------------

    def _draw(self, key: Array) -> tuple[Array, Array, Any, dict[str, Array]]:
        """The start of an episode, as `place` and `randomise` draw it."""
        return *self.place(key), self.randomise(jax.random.fold_in(key, MODEL_FIELDS))

    def _begin(self, physics: Physics, game: Any) -> State:
        actions = {a.name: jnp.zeros(a.action_size) for a in self.agents}
        alive, observations = self._look(physics, game, actions)
        bare = physics._replace(carry=())
        verdict = undecided(jax.eval_shape(self.judge, bare, bare, game)[1])
        teams = jnp.zeros(len(self.teams), bool)
        return State(physics, game, observations, actions, verdict, jnp.zeros((), bool), teams, alive)

    def _ahead(self, physics: Physics, command: Array) -> Moved | None:
        """All control steps of a decision, stacked, where the engine can make them before the game judges the first.

        Where somebody may drop out of the game between two of them, its command changes with that.
        """
        if self._mortal:
            return None
        return self.engine.ahead(physics, command, self.timing.substeps, self.law, self.timing.hold)

    def _of_the_living(self, actions: dict[str, Array], alive: Array) -> dict[str, Array]:
        """The actions (act,) that are carried out where `alive` (agents,) bool."""
        if not self._mortal:
            return actions
        limp = {a: jnp.array(robot.limp or [0.0] * robot.action_size) for a, robot in self.robots.items()}
        return {a: jnp.where(on, actions[a], limp[a]) for a, on in zip(self.robots, alive, strict=True)}

    def _look(self, physics: Physics, game: Any, actions: dict[str, Array]) -> tuple[Array, dict[str, Array]]:
        """Who is alive (agents,) bool, and what each agent sees of it: zeros for who is not."""
        alive, seen = self.alive(physics, game), finite(self.observe(physics, game, actions))
        if not self._mortal:
            return alive, seen
        return alive, {a: jnp.where(on, seen[a], 0.0) for a, on in zip(self.robots, alive, strict=True)}

    def _neutral(self, state: State) -> State:
        """The state with what its engine saves of it in place of the engine's own."""
        return state._replace(physics=self.engine.save(state.physics))

    def _wild(self, actions: dict[str, Array]) -> Array:
        """(teams,) bool: who acts with numbers that are not finite."""
        return jnp.stack([
            jnp.stack([~jnp.all(jnp.isfinite(actions[agent])) for agent in agents]).any()
            for agents in self._rosters.values()
        ])  # fmt: skip

    def _culprits(self, physics: Physics, wild: Array) -> Array:
        """(teams,) bool: who brought bad numbers into a world that is void from now on.

        Wild actions tell it. Else the numbers of the robots do, as long as they spread to one team alone; a contact
        buffer that overflows tells nothing.
        """
        bad = jnp.stack([
            ~jnp.stack([self._sound(agent, physics) for agent in agents]).all() for agents in self._rosters.values()
        ])  # fmt: skip
        alone = bad if len(self._rosters) == 1 else bad & ~bad.all()
        return jnp.where(wild.any(), wild, alone)

    def _sound(self, agent: str, physics: Physics) -> Array:
        at = self.scene.agents.get(agent)
        return sound(physics.qpos[at.own_qpos], physics.qvel[at.own_qvel]) if at else jnp.ones((), bool)


def _path(path: tuple) -> str:
    return jax.tree_util.keystr(path, simple=True, separator="/")


def _data(leaf: Array) -> Array:
    """A leaf as plain numbers: of a random key those that it is made of."""
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


def _typed(values: Array, like: jax.ShapeDtypeStruct) -> Array:
    """Saved numbers as what they were."""
    if jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(values)
    return jnp.asarray(values, like.dtype)
