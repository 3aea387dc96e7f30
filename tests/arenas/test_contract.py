"""Every arena keeps the contract on every engine, and the examination catches those that do not."""

import itertools
import re
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from race import Race, RaceRules, RaceSettings

import arenas
from arenas.check import PROMISES, WORLDS, check_arena
from arenas.trial import Trial

RACE = RaceSettings(rules=RaceRules(episode=1.0))


def broken(name, engine):
    settings = arenas.settings(name)
    arena = settings.build(engine=engine, worlds=WORLDS)
    assert arena.engine.name == engine
    return [promise for promise in check_arena(arena, settings) if not promise.ok]


@pytest.mark.parametrize("name", arenas.names())
def test_arenas_keep_the_contract(name):
    assert broken(name, "c") == []


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["jax", "warp"])
def test_arenas_keep_the_contract_on_accelerators(engine):
    assert broken("sumo-1v1", engine) == []


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


class Infinite(Race):
    def judge(self, before, physics, game):
        game, verdict = super().judge(before, physics, game)
        return game, verdict._replace(shaping=jnp.array([0.0, jnp.inf]))


class Generous(Race):
    def judge(self, before, physics, game):
        game, verdict = super().judge(before, physics, game)
        return game, verdict._replace(score=jnp.ones(2))


class Undecided(Race):
    def step_with_frames(self, state, actions):
        state, frames = super().step_with_frames(state, actions)
        return state._replace(verdict=state.verdict._replace(reward=jnp.ones(2))), frames


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
    def scripts(self):
        return {"shout": lambda observation, key: observation}


class Unpainted(Race):
    marker_kinds = {"flag": "square"}  # noqa: RUF012  (a wrong one)


class Ghostly(Race):
    def observe(self, physics, game, actions):
        return super().observe(physics, game, actions) | {"green/0": jnp.zeros(6)}


class Weighty(Race):
    def reset(self, key):
        state = super().reset(key)
        return state._replace(actions={name: a.astype(jnp.float16) for name, a in state.actions.items()})


# arena, how the promise that it breaks begins, what is said of it
BROKEN = [
    (Ghostly, "agents are named", "green/0"),
    (Unsized, "observations have", r"blue/0 sees \(6,\) float32, not \(7,\)"),
    (Weighty, "reset and step give", "lax.scan"),
    (Infinite, "rewards, shaping", "shaping has shape"),
    (Endless, "an episode ends", "8 of 8 worlds go on after 10 decisions"),
    (TwiceEnded, "an end is", "two of them"),
    (Undecided, "a verdict once", "changes after the end"),
    (Generous, "scores lie", r"\[\[1.0, 1.0\]\]"),
    (Haphazard, "the key decides", "game differs, by up to"),
    (Gossiping, "worlds do not", "observations"),
    (Nostalgic, "a restarted world", "verdict"),
    (Sweeping, "a restart leaves", "physics.qpos differs, by up to"),
    (Unshakeable, "unstable physics", r"make these void: \[\]"),
    (Misspoken, "scripts give", r"shout tells blue/0 \(6,\) numbers, not 2 finite ones"),
    (Unpainted, "frames and markers", "kinds: circle"),
]


@pytest.mark.parametrize(("arena", "promise", "detail"), BROKEN)
def test_a_broken_promise_is_noticed(arena, promise, detail):
    (problem,) = (problem for name, problem in PROMISES.items() if name.startswith(promise))
    assert re.search(detail, problem(Trial(arena(RACE, engine="c"), jax.random.key(0))))


def test_every_promise_has_been_seen_broken():
    assert [next(name for name in PROMISES if name.startswith(start)) for _, start, _ in BROKEN] == list(PROMISES)


@dataclass(frozen=True)
class Careless(RaceSettings):
    def build(self, **where):
        return Race(replace(self, rules=RaceRules(episode=1.0)), **where)


def test_rules_that_do_not_count_are_noticed():
    settings = Careless(rules=RACE.rules)
    *others, last = check_arena(settings.build(engine="c"), settings)
    assert [p for p in others if not p.ok] == []
    assert last[:2] == ("the configuration hash follows the rules", False)
    assert "rules.reach = " in last.detail


class Stumbling(Race):
    def place(self, key):
        raise IndexError("no such flag\nand more")


def test_an_arena_that_does_not_run_breaks_one_promise():
    (only,) = check_arena(Stumbling(RACE, engine="c"))
    assert only == ("reset and step run under jit and vmap", False, "IndexError: no such flag")
