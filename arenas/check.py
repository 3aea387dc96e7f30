"""The contract of an arena as a callable, for our arenas and for yours.

    for name, ok, detail in check_arena(arenas.load("duel.py:duel", worlds=WORLDS)):
        print(name, "ok" if ok else detail)

Each promise is one function below, in the order in which they are tried.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena, ArenaError, Settings
from arenas.trial import WORLDS, Trial, apart, view

MARKERS = {"circle": 3}  # numbers of each kind that can be drawn

Problem = Callable[[Trial], str]
PROMISES: dict[str, Problem] = {}


class Promise(NamedTuple):
    """One property of an arena and whether it holds."""

    name: str
    ok: bool
    detail: str = ""


def check_arena(arena: Arena, settings: Settings | None = None, *, key: Array | None = None) -> list[Promise]:
    """Try every promise of the contract; `arena` is built for at least WORLDS worlds.

    With the `settings` that it was built from, the configuration hash is tried too. Where `reset` and `step` do not
    even run, that is the one promise told. Raises nothing: what an arena's own code raises is a promise broken.
    """
    basis = "reset and step run under jit and vmap"
    try:
        trial = Trial(arena, jax.random.key(0) if key is None else key)
    except Exception as error:
        return [Promise(basis, False, _line(error))]
    tried = [Promise(basis, True), *(_try(name, problem, trial) for name, problem in PROMISES.items())]
    if settings is not None:
        tried.append(_try("the configuration hash follows the rules", _hash, trial.arena, settings))
    return tried


def _try(name: str, problem: Callable[..., str], *of: Any) -> Promise:
    try:
        detail = problem(*of)
    except Exception as error:
        detail = _line(error)
    return Promise(name, not detail, detail)


def promise(name: str) -> Callable[[Problem], Problem]:
    """List a function among PROMISES; it says what is wrong, or nothing."""

    def listed(problem: Problem) -> Problem:
        PROMISES[name] = problem
        return problem

    return listed


@promise("agents are named team/index, as are their bodies and observations")
def _names(trial: Trial) -> str:
    model, agents = trial.arena.scene.model, [agent.name for agent in trial.arena.agents]
    bodies = [model.body(i).name for i in range(model.nbody)]
    if agents != [f"{team.name}/{i}" for team in trial.arena.teams for i in range(len(team.agents))]:
        return f"agents {agents}"
    bare = [name for name in agents if not any(body.startswith(f"{name}/") for body in bodies)]
    if bare:
        return f"no body of the model begins with {bare[0]}/"
    seeing = set(trial.first.observations)
    return "" if seeing == set(agents) else f"observations are of {sorted(seeing)}, agents are {agents}"


@promise("observations have the declared sizes and are finite")
def _observations(trial: Trial) -> str:
    for agent in trial.arena.agents:
        values = trial.episode[0].observations[agent.name]
        if values.shape[2:] != (agent.observation_size,) or values.dtype != np.float32:
            return f"{agent.name} sees {values.shape[2:]} {values.dtype}, not ({agent.observation_size},) float32"
        if not np.isfinite(values).all():
            return f"{agent.name} sees numbers that are not finite"
    return ""


@promise("reset and step give states of one shape")
def _shapes(trial: Trial) -> str:
    one, other = (jax.tree.map(lambda x: (x.shape, x.dtype), state) for state in (trial.first, trial.second))
    return "" if one == other else "lax.scan needs the state after a step to be shaped as after reset"


@promise("rewards, shaping and scores are finite, one number per team")
def _verdicts(trial: Trial) -> str:
    verdict, teams = trial.episode[0].verdict, len(trial.arena.teams)
    for name in ("reward", "shaping", "score"):
        value = getattr(verdict, name)
        if value.shape[2:] != (teams,) or not np.isfinite(value).all():
            return f"{name} has shape {value.shape[2:]}, not ({teams},), or is not finite"
    ends = (verdict.terminated, verdict.truncated)
    return "" if all(x.ndim == 2 and x.dtype == bool for x in ends) else "terminated and truncated must be () bool"


@promise("an episode ends in time")
def _ends(trial: Trial) -> str:
    decisions = trial.arena.timing.decisions
    late = WORLDS - int(trial.episode[0].done[decisions].sum())
    return f"{late} of {WORLDS} worlds go on after {decisions} decisions" if late else ""


@promise("an end is terminated, truncated or void")
def _one_end(trial: Trial) -> str:
    seen = trial.episode[0]
    ends = np.sum([seen.verdict.terminated, seen.verdict.truncated, seen.void], axis=0)
    return "" if ends.max() <= 1 else "a world is two of them at once"


@promise("a verdict once given stays")
def _stays(trial: Trial) -> str:
    seen = trial.episode[0]
    reward, shaping, *outcome = seen.verdict
    changed = [x[1:] != x[:-1] for x in (*outcome, seen.void)] + [x[1:] != 0 for x in (reward, shaping)]
    return "it changes after the end" if any(x[seen.done[:-1]].any() for x in changed) else ""


@promise("scores lie between 0 and 1, and two teams share 1")
def _scores(trial: Trial) -> str:
    seen = trial.episode[0]
    score = seen.verdict.score[-1][seen.done[-1] & ~seen.void[-1]]  # (ended worlds, teams)
    if score.size == 0:
        return "no episode of random play ended with a score"
    fair = score.shape[1] != 2 or np.allclose(score.sum(axis=1), 1.0)
    return "" if fair and score.min() >= 0 and score.max() <= 1 else f"scores {np.unique(score, axis=0).tolist()}"


@promise("the key decides everything")
def _key(trial: Trial) -> str:
    again = trial.reset(trial.keys)
    same = apart(view(again), view(trial.first), 0.0)
    return same or apart(view(trial.step(again)), view(trial.second))


@promise("worlds do not influence each other")
def _alone(trial: Trial) -> str:
    order = np.roll(np.arange(WORLDS)[::-1], 3)
    shuffled = trial.step(trial.reset(trial.keys[order]), order=order)
    return apart(view(shuffled), view(trial.second, order))


@promise("a restarted world is as good as a fresh one")
def _fresh(trial: Trial) -> str:
    begun = trial.restart(trial.episode[1], trial.keys, jnp.ones(WORLDS, bool))
    return apart(view(begun), view(trial.first), 1e-5) or apart(view(trial.step(begun)), view(trial.second))


@promise("a restart leaves other worlds alone")
def _others(trial: Trial) -> str:
    kept = np.arange(WORLDS) % 2 == 0
    mixed = trial.restart(trial.second, trial.keys, jnp.asarray(~kept))
    return apart(view(mixed, kept), view(trial.second, kept), 1e-5)


@promise("unstable physics makes a world void until its restart")
def _unstable(trial: Trial) -> str:
    physics, broken = trial.first.physics, np.arange(WORLDS) < 2
    speed = physics.qvel.at[0].set(jnp.nan).at[1].set(1e20)
    after = trial.step(trial.first._replace(physics=trial.place(physics, physics.qpos, speed, jnp.asarray(broken))))
    if not np.array_equal(after.void, broken):
        return f"NaN in world 0 and 1e20 m/s in world 1 make these void: {np.flatnonzero(after.void).tolist()}"
    if not all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves((after.observations, after.verdict))):
        return "void worlds show numbers that are not finite"
    begun = trial.restart(after, trial.keys, after.void)
    others = apart(view(after, ~broken), view(trial.second, ~broken))
    return others or apart(view(begun, broken), view(trial.first, broken), 1e-5)


@promise("scripts give fitting, finite actions")
def _scripts(trial: Trial) -> str:
    for name, script in trial.arena.scripts().items():
        for agent in trial.arena.agents:
            action = jax.jit(jax.vmap(script))(trial.second.observations[agent.name], trial.keys)
            if action.shape[1:] != (agent.action_size,) or not jnp.isfinite(action).all():
                return f"{name} tells {agent.name} {action.shape[1:]} numbers, not {agent.action_size} finite ones"
    return ""


@promise("frames and markers are as declared")
def _frames(trial: Trial) -> str:
    frames, kinds, timing = trial.frames, trial.arena.marker_kinds, trial.arena.timing
    if set(kinds) != set(frames.markers) or set(kinds.values()) - set(MARKERS):
        return f"markers {sorted(frames.markers)} declared as {dict(kinds)}; kinds: {', '.join(MARKERS)}"
    for name, value in frames.markers.items():
        if value.shape[2:] != (MARKERS[kinds[name]],):
            return f"marker {name} has shape {value.shape[2:]}: a {kinds[name]} is {MARKERS[kinds[name]]} numbers"
    due = timing.control_interval * np.arange(1, timing.hold + 1)
    return "" if np.allclose(frames.time, due, atol=1e-5) else "frames are not one control interval apart"


def _hash(arena: Arena, settings: Any) -> str:
    if settings.build(engine="c").config_hash != arena.config_hash:
        return "the same settings give another one"
    rules: Any = getattr(settings, "rules", None)
    for field in fields(rules) if rules else ():
        for other in _near(getattr(rules, field.name)):
            try:
                changed = replace(settings, rules=replace(rules, **{field.name: other})).build(engine="c")
            except (ValueError, ArenaError):
                continue  # a value that the rules do not allow
            if changed.config_hash == arena.config_hash:
                return f"rules.{field.name} = {other} does not change it"
    return ""


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


def _line(error: Exception) -> str:
    """An exception as one line."""
    return f"{type(error).__name__}: {(str(error) or 'no message').splitlines()[0]}"
