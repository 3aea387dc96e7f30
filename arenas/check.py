"""The contract of an arena as a callable, for our arenas and for yours.

    for name, ok, detail in check_arena(arenas.load("duel.py:duel", worlds=WORLDS)):
        print(name, "ok" if ok else detail)

Each promise is one function below; it answers with what is wrong, or with nothing.
"""

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena, ArenaError, Settings, State

WORLDS = 8  # simulated together; an arena on Warp sizes its buffers by this
CLOSE = 1e-3  # what one decision may differ by where a GPU adds in another order; on the C engine nothing differs
MARKERS = {"circle": 3}  # numbers of each kind that can be drawn


class Promise(NamedTuple):
    """One property of an arena and whether it holds."""

    name: str
    ok: bool
    detail: str = ""


def check_arena(arena: Arena, settings: Settings | None = None, *, key: Array | None = None) -> list[Promise]:
    """Try every promise of the contract; `arena` is built for at least WORLDS worlds.

    With the `settings` that it was built from, the configuration hash is tried too. Where `reset` and `step` do not even
    compile, that is the one promise told. Raises nothing: what an arena's own code raises is a promise broken.
    """
    basis = "reset and step run under jit and vmap"
    try:
        trial = _Trial(arena, settings, jax.random.key(0) if key is None else key)
    except Exception as error:
        return [Promise(basis, False, _line(error))]
    return [Promise(basis, True), *(_try(name, trial) for name in PROMISES if settings or PROMISES[name] is not _hash)]


class _Trial:
    """An arena with its verbs compiled, and an episode of random play in each of its worlds."""

    def __init__(self, arena: Arena, settings: Settings | None, key: Array):
        self.arena, self.settings, self.key = arena, settings, key
        self.keys = jax.random.split(key, WORLDS)
        self.reset, self.restart = jax.jit(jax.vmap(arena.reset)), jax.jit(jax.vmap(arena.restart))
        self.place, self._step = jax.jit(jax.vmap(arena.engine.place)), jax.jit(jax.vmap(arena.step_with_frames))
        self.first = self.reset(self.keys)
        self.second, self.frames = self._step(self.first, self.actions(0))

    def actions(self, decision: int) -> dict[str, Array]:
        """Actions (WORLDS, act) for one decision, uniform within ±1."""
        keys = jax.random.split(jax.random.fold_in(self.key, decision), len(self.arena.agents))
        return {
            agent.name: jax.random.uniform(key, (WORLDS, agent.action_size), minval=-1.0)
            for agent, key in zip(self.arena.agents, keys, strict=True)
        }

    def step(self, state: State, decision: int = 0, order: Any = slice(None)) -> State:
        """One decision with its random actions, those of world `order[i]` in world i."""
        return self._step(state, jax.tree.map(lambda x: x[order], self.actions(decision)))[0]

    @cached_property
    def episode(self) -> tuple[State, State]:
        """What learners see (T, WORLDS, ...) until two decisions after the latest end, and the last state whole."""
        state, seen = self.second, [_seen(self.first), _seen(self.second)]
        for decision in range(1, self.arena.timing.decisions + 2):
            state = self.step(state, decision)
            seen.append(_seen(state))
        return jax.tree.map(lambda *x: np.stack(x), *seen), state


def _try(name: str, trial: _Trial) -> Promise:
    try:
        problem = PROMISES[name](trial)
    except Exception as error:
        problem = _line(error)
    return Promise(name, not problem, problem)


def _names(trial: _Trial) -> str:
    model, agents = trial.arena.scene.model, [agent.name for agent in trial.arena.agents]
    bodies = [model.body(i).name for i in range(model.nbody)]
    if agents != [f"{team.name}/{i}" for team in trial.arena.teams for i in range(len(team.agents))]:
        return f"agents {agents}"
    bare = [name for name in agents if not any(body.startswith(f"{name}/") for body in bodies)]
    if bare:
        return f"no body of the model begins with {bare[0]}/"
    seeing = set(trial.first.observations)
    return "" if seeing == set(agents) else f"observations are of {sorted(seeing)}, agents are {agents}"


def _observations(trial: _Trial) -> str:
    for agent in trial.arena.agents:
        values = trial.episode[0].observations[agent.name]
        if values.shape[2:] != (agent.observation_size,) or values.dtype != np.float32:
            return f"{agent.name} sees {values.shape[2:]} {values.dtype}, not ({agent.observation_size},) float32"
        if not np.isfinite(values).all():
            return f"{agent.name} sees numbers that are not finite"
    return ""


def _shapes(trial: _Trial) -> str:
    one, other = (jax.tree.map(lambda x: (x.shape, x.dtype), state) for state in (trial.first, trial.second))
    return "" if one == other else "lax.scan needs the state after a step to be shaped as after reset"


def _verdicts(trial: _Trial) -> str:
    verdict, teams = trial.episode[0].verdict, len(trial.arena.teams)
    for name in ("reward", "shaping", "score"):
        value = getattr(verdict, name)
        if value.shape[2:] != (teams,) or not np.isfinite(value).all():
            return f"{name} has shape {value.shape[2:]}, not ({teams},), or is not finite"
    ends = (verdict.terminated, verdict.truncated)
    return "" if all(x.ndim == 2 and x.dtype == bool for x in ends) else "terminated and truncated must be () bool"


def _ends(trial: _Trial) -> str:
    decisions = trial.arena.timing.decisions
    late = WORLDS - int(trial.episode[0].done[decisions].sum())
    return f"{late} of {WORLDS} worlds go on after {decisions} decisions" if late else ""


def _one_end(trial: _Trial) -> str:
    seen = trial.episode[0]
    ends = np.sum([seen.verdict.terminated, seen.verdict.truncated, seen.void], axis=0)
    return "" if ends.max() <= 1 else "a world is two of them at once"


def _stays(trial: _Trial) -> str:
    seen = trial.episode[0]
    reward, shaping, *outcome = seen.verdict
    changed = [x[1:] != x[:-1] for x in (*outcome, seen.void)] + [x[1:] != 0 for x in (reward, shaping)]
    return "it changes after the end" if any(x[seen.done[:-1]].any() for x in changed) else ""


def _scores(trial: _Trial) -> str:
    seen = trial.episode[0]
    score = seen.verdict.score[-1][seen.done[-1] & ~seen.void[-1]]  # (ended worlds, teams)
    if score.size == 0:
        return "no episode of random play ended with a score"
    fair = score.shape[1] != 2 or np.allclose(score.sum(axis=1), 1.0)
    return "" if fair and score.min() >= 0 and score.max() <= 1 else f"scores {np.unique(score, axis=0).tolist()}"


def _key(trial: _Trial) -> str:
    again = trial.reset(trial.keys)
    return _apart(again, trial.first, 0.0) or _apart(trial.step(again), trial.second)


def _alone(trial: _Trial) -> str:
    order = np.roll(np.arange(WORLDS)[::-1], 3)
    return _apart(trial.step(trial.reset(trial.keys[order]), order=order), trial.second, other_worlds=order)


def _fresh(trial: _Trial) -> str:
    begun = trial.restart(trial.episode[1], trial.keys, jnp.ones(WORLDS, bool))
    return _apart(begun, trial.first, 1e-5) or _apart(trial.step(begun), trial.second)


def _others(trial: _Trial) -> str:
    kept = np.arange(WORLDS) % 2 == 0
    mixed = trial.restart(trial.second, trial.keys, jnp.asarray(~kept))
    return _apart(mixed, trial.second, 1e-5, kept, kept)


def _unstable(trial: _Trial) -> str:
    physics, broken = trial.first.physics, np.arange(WORLDS) < 2
    speed = physics.qvel.at[0].set(jnp.nan).at[1].set(1e20)
    after = trial.step(trial.first._replace(physics=trial.place(physics, physics.qpos, speed, jnp.asarray(broken))))
    if not np.array_equal(after.void, broken):
        return f"NaN in world 0 and 1e20 m/s in world 1 make these void: {np.flatnonzero(after.void).tolist()}"
    if not all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves((after.observations, after.verdict))):
        return "void worlds show numbers that are not finite"
    begun = trial.restart(after, trial.keys, after.void)
    return _apart(after, trial.second, CLOSE, ~broken, ~broken) or _apart(begun, trial.first, 1e-5, broken, broken)


def _scripts(trial: _Trial) -> str:
    for name, script in trial.arena.scripts().items():
        for agent in trial.arena.agents:
            action = jax.jit(jax.vmap(script))(trial.second.observations[agent.name], trial.keys)
            if action.shape[1:] != (agent.action_size,) or not jnp.isfinite(action).all():
                return f"{name} tells {agent.name} {action.shape[1:]} numbers, not {agent.action_size} finite ones"
    return ""


def _frames(trial: _Trial) -> str:
    frames, kinds, timing = trial.frames, trial.arena.marker_kinds, trial.arena.timing
    if set(kinds) != set(frames.markers) or set(kinds.values()) - set(MARKERS):
        return f"markers {sorted(frames.markers)} declared as {dict(kinds)}; kinds: {', '.join(MARKERS)}"
    for name, value in frames.markers.items():
        if value.shape[2:] != (MARKERS[kinds[name]],):
            return f"marker {name} has shape {value.shape[2:]}: a {kinds[name]} is {MARKERS[kinds[name]]} numbers"
    due = timing.control_interval * np.arange(1, timing.hold + 1)
    return "" if np.allclose(frames.time, due, atol=1e-5) else "frames are not one control interval apart"


def _hash(trial: _Trial) -> str:
    settings = trial.settings
    assert settings is not None
    if settings.build(engine="c").config_hash != trial.arena.config_hash:
        return "the same settings give another one"
    rules = getattr(settings, "rules", None)
    for field in fields(rules) if is_dataclass(rules) else ():
        for other in _near(getattr(rules, field.name)):
            try:
                changed: Any = replace(settings, **{"rules": replace(rules, **{field.name: other})})
                digest = changed.build(engine="c").config_hash
            except (ValueError, ArenaError):
                continue  # a value that the rules do not allow
            if digest == trial.arena.config_hash:
                return f"rules.{field.name} = {other} does not change it"
    return ""


PROMISES: dict[str, Callable[[_Trial], str]] = {
    "agents are named team/index, as are their bodies and observations": _names,
    "observations have the declared sizes and are finite": _observations,
    "reset and step give states of one shape": _shapes,
    "rewards, shaping and scores are finite, one number per team": _verdicts,
    "an episode ends in time": _ends,
    "an end is terminated, truncated or void": _one_end,
    "a verdict once given stays": _stays,
    "scores lie between 0 and 1, and two teams share 1": _scores,
    "the key decides everything": _key,
    "worlds do not influence each other": _alone,
    "a restarted world is as good as a fresh one": _fresh,
    "a restart leaves other worlds alone": _others,
    "unstable physics makes a world void until its restart": _unstable,
    "scripts give fitting, finite actions": _scripts,
    "frames and markers are as declared": _frames,
    "the configuration hash follows the rules": _hash,
}


def _seen(state: State) -> State:
    """What learners see of a batch of worlds, on the host."""
    return jax.device_get(state._replace(physics=(), game=(), actions=()))


def _near(value: Any) -> tuple:
    """Other values of a rule, of which some may be allowed."""
    match value:
        case bool():
            return (not value,)
        case int():
            return (value + 1, value - 1)
        case float():
            return (1.1 * value + 0.01, 0.9 * value, 2.0 * value)
        case (int() | float(), *_):
            return (tuple(1.1 * each for each in value),)
    return ()


def _apart(
    one: State, other: State, tolerance: float = CLOSE, worlds: Any = slice(None), other_worlds: Any = slice(None)
) -> str:
    """Where two batches of states differ, engines' own buffers apart; a NaN equals a NaN."""
    sides = []
    for state, index in ((one, worlds), (other, other_worlds)):
        own = state._replace(physics=state.physics._replace(carry=()))
        sides.append(jax.tree_util.tree_leaves_with_path(jax.tree.map(lambda x: _plain(x)[index], own)))  # noqa: B023
    for (path, x), (_, y) in zip(*sides, strict=True):
        if not np.allclose(x, y, rtol=tolerance, atol=tolerance, equal_nan=True):
            gap = np.nanmax(np.abs(x.astype(float) - y.astype(float)))
            return f"{jax.tree_util.keystr(path)[1:]} differs, by up to {gap:.2g}"
    return ""


def _plain(values: Array) -> np.ndarray:
    is_key = jnp.issubdtype(values.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(values) if is_key else values)


def _line(error: Exception) -> str:
    """An exception as one line."""
    return f"{type(error).__name__}: {(str(error) or 'no message').splitlines()[0]}"
