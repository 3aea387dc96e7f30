"""Arenas that each break a promise of the contract, and one in which somebody is out of the game."""

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from arenas.description import Entities
from tests.arenas.race import Race


class Unsized(Race):
    def observation_size(self, agent):
        return 7


class Endless(Race):
    def judge(self, before, physics, game):
        game, verdict = super().judge(before, physics, game)
        return game, verdict._replace(terminated=jnp.zeros((), bool))


class TwiceEnded(Race):
    def judge(self, before, physics, game):
        game, verdict = super().judge(before, physics, game)
        return game, verdict._replace(truncated=verdict.terminated)


class Doomed(Race):
    """Red is out of the game from 0.45 s on, amid a decision."""

    exchangeable = False

    def alive(self, physics, game):
        return jnp.stack([jnp.ones((), bool), physics.time < 0.45])


class Haunted(Doomed):
    def step_with_frames(self, state, actions):
        return super().step_with_frames(state._replace(alive=jnp.ones_like(state.alive)), actions)


class Halved(Race):
    def alive(self, physics, game):
        return jnp.ones(1, bool)


class Infinite(Race):
    def judge(self, before, physics, game):
        game, verdict = super().judge(before, physics, game)
        return game, verdict._replace(shapings={"approach": jnp.array([0.0, jnp.inf])})


class Generous(Race):
    def judge(self, before, physics, game):
        game, verdict = super().judge(before, physics, game)
        return game, verdict._replace(score=jnp.ones(2))


class Undecided(Race):
    def step_with_frames(self, state, actions):
        state, frames = super().step_with_frames(state, actions)
        return state._replace(verdict=state.verdict._replace(rewards={"lead": jnp.ones(2)})), frames


class Haphazard(Race):
    calls = itertools.count()

    def place(self, key):
        qpos, qvel, flag = super().place(key)
        luck = jax.pure_callback(
            lambda x: np.float32(next(self.calls)) + 0 * x,
            jax.ShapeDtypeStruct((), jnp.float32),
            flag[0],
            vmap_method="broadcast_all",
        )
        return qpos, qvel, flag + 0.01 * luck


class Gossiping(Race):
    def observe(self, physics, game, actions):
        overheard = jax.pure_callback(
            lambda x: np.roll(x, 1), jax.ShapeDtypeStruct((), jnp.float32), physics.qpos[0], vmap_method="broadcast_all"
        )
        return {name: x.at[0].set(overheard) for name, x in super().observe(physics, game, actions).items()}


class Nostalgic(Race):
    def restart(self, state, key, where):
        return super().restart(state, key, where)._replace(verdict=state.verdict)


class Sweeping(Race):
    def restart(self, state, key, where):
        return super().restart(state, key, jnp.ones_like(where))


class Unshakeable(Race):
    def step_with_frames(self, state, actions):
        state, frames = super().step_with_frames(state, actions)
        return state._replace(void=jnp.zeros((), bool)), frames


class Misspoken(Race):
    def game_scripts(self):
        return {"shout": {"puck": lambda observation, key: observation}}


class Unsorted(Race):
    def observation_entities(self, agent):
        return (Entities("rivals", ((0, 1), (5, 6))),)


class Miscounted(Race):
    def __init__(self, settings, **where):
        super().__init__(settings, **where)
        self.robots = {name: replace(robot, sets={"size": (0.5, 2.0)}) for name, robot in self.robots.items()}


class Unpainted(Race):
    def __init__(self, settings, **where):
        super().__init__(settings, **where)
        self.marker_kinds = {"flag": "square"}


class Renamed(Race):
    def __init__(self, settings, **where):
        super().__init__(settings, **where)
        blue, red = self.teams
        self.teams = (replace(blue, agents=red.agents), replace(red, agents=blue.agents))


class Blind(Race):
    def observe(self, physics, game, actions):
        seen = super().observe(physics, game, actions)
        return {name: x.at[4].set(x[4] / (physics.time > 0.55)) for name, x in seen.items()}  # inf after half a second


class Shattered(Race):
    """No fault: its physics fails after the end, as that of robots that fall off the edge does."""

    def step_with_frames(self, state, actions):
        after, frames = super().step_with_frames(state, actions)
        speed = jnp.where(state.done, jnp.nan, after.physics.qvel)
        causes = jnp.where(state.done, jnp.uint8(1), after.physics.causes)
        return after._replace(physics=after.physics._replace(qvel=speed, causes=causes)), frames


class Partial(Race):
    def observe(self, physics, game, actions):
        seen = super().observe(physics, game, actions)
        return seen | {"red/0": seen["red/0"].at[2:4].multiply(1.01)}  # red thinks the flag further away


class Stingy(Race):
    def judge(self, before, physics, game):
        game, verdict = super().judge(before, physics, game)
        return game, verdict._replace(rewards={"lead": verdict.rewards["lead"][:1]})


class Nameless(Race):
    def judge(self, before, physics, game):
        game, verdict = super().judge(before, physics, game)
        return game, verdict._replace(events={"a/b": jnp.zeros(2, bool)})


class Whole(Race):
    def observe(self, physics, game, actions):
        return {name: x.astype(int) for name, x in super().observe(physics, game, actions).items()}


class Forgetful(Race):
    def load(self, saved):
        state = super().load(saved)
        return state._replace(physics=state.physics._replace(time=jnp.zeros(())))


class Trusting(Race):
    def step_with_frames(self, state, actions):
        return super().step_with_frames(state, {name: jnp.nan_to_num(a) for name, a in actions.items()})


class Embellished(Race):
    def step_with_frames(self, state, actions):
        state, frames = super().step_with_frames(state, actions)
        return state, frames._replace(shapings={"approach": frames.shapings["approach"] + 1.0})


class Zeroed(Race):
    def step_with_frames(self, state, actions):
        state, frames = super().step_with_frames(state, actions)
        return state, frames._replace(qpos=jnp.zeros_like(frames.qpos))


class Ghostly(Race):
    def observe(self, physics, game, actions):
        return super().observe(physics, game, actions) | {"green/0": jnp.zeros(6)}


class Weighty(Race):
    def reset(self, key):
        state = super().reset(key)
        return state._replace(actions={name: a.astype(jnp.float16) for name, a in state.actions.items()})
