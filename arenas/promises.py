"""The promises of the contract, one function each: what is wrong with an arena under trial, or nothing."""

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena
from arenas.errors import ArenaError
from arenas.trial import CLOSE, RECORDED, WORLDS, Trial, apart, view

Problem = Callable[[Trial], str]
PROMISES: dict[str, Problem] = {}


def promise(name: str) -> Callable[[Problem], Problem]:
    """List a function among PROMISES; it says what is wrong, or nothing."""

    def listed(problem: Problem) -> Problem:
        PROMISES[name] = problem
        return problem

    return listed


def runs(trial: Trial) -> str:
    """The worlds reset and take one decision, or what that raises."""
    jax.block_until_ready((trial.first, trial.second))
    return ""


@promise("agents are named team/index, as are their bodies")
def _names(trial: Trial) -> str:
    arena, agents = trial.arena, [agent.name for agent in trial.arena.agents]
    bodies = [arena.scene.model.body(i).name for i in range(arena.scene.model.nbody)]
    if agents != [f"{team.name}/{i}" for team in arena.teams for i in range(len(team.agents))]:
        return f"agents {agents}"
    bare = [n for n in agents if arena.robots[n].build and not any(body.startswith(f"{n}/") for body in bodies)]
    return f"no body of the model begins with {bare[0]}/" if bare else ""


@promise("observations are finite")
def _observations(trial: Trial) -> str:
    raw, void = trial.episode.raw, trial.episode.seen.void
    for agent, values in raw.items():
        bad = ~np.isfinite(values[~void]).all(axis=0)  # (obs,)
        if bad.any():
            return f"{agent} sees numbers that are not finite, at index {', '.join(map(str, np.flatnonzero(bad)))}"
    return ""


@promise("equal teams in each other's places see what the others saw")
def _exchanged(trial: Trial) -> str:
    arena, state = trial.arena, trial.second
    if len(arena.teams) != 2 or arena.teams[0].roster != arena.teams[1].roster:
        return ""
    blue, red = ([agent.name for agent in team.agents] for team in arena.teams)
    other = dict(zip(blue + red, red + blue, strict=True))
    observe, every = jax.jit(jax.vmap(arena.observe)), jnp.ones(WORLDS, bool)

    def seen(qpos: Array, qvel: Array, game: Any, actions: Mapping[str, Array]) -> dict[str, Array]:
        return observe(trial.place(state.physics, qpos, qvel, every, state.physics.model), game, actions)

    start = state.physics.qpos, state.physics.qvel, state.game
    before = seen(*start, state.actions)
    qpos, qvel, game = jax.jit(jax.vmap(arena.exchange))(*start)
    after = seen(qpos, qvel, game, {name: state.actions[other[name]] for name in other})
    return apart(
        {f"what {other[name]} sees": after[other[name]] for name in other},
        {f"what {other[name]} sees": before[name] for name in other},
        CLOSE,
    )


@promise("reset and step give states of one shape")
def _shapes(trial: Trial) -> str:
    one, other = (jax.tree.map(lambda x: (x.shape, x.dtype), state) for state in (trial.first, trial.second))
    return "" if one == other else "lax.scan needs the state after a step to be shaped as after reset"


@promise("who is out of the game neither acts nor sees")
def _out(trial: Trial) -> str:
    """In the first decision of random play before which somebody is out of a game that goes on, if there is one."""
    seen, agents = trial.episode.seen, trial.arena.agents
    out = ~seen.alive & ~seen.done[..., None]  # (T, WORLDS, agents)
    for i, agent in enumerate(agents):
        if seen.observations[agent.name][out[..., i]].any():
            return f"{agent.name} sees something while it is out"
    if not out.any():
        return ""
    at, state = int(np.argwhere(out)[0, 0]), trial.first
    for decision in range(at):
        state = trial.step(state, decision)
    actions = trial.actions(at)
    wild = {a.name: jnp.where(out[at][:, i, None], jnp.nan, actions[a.name]) for i, a in enumerate(agents)}
    return apart(view(trial.act(state, wild)), view(trial.act(state, actions)))


@promise("rewards, shapings and scores are finite")
def _verdicts(trial: Trial) -> str:
    verdict = trial.episode.seen.verdict
    numbers = {**verdict.rewards, **verdict.shapings, "score": verdict.score}
    bad = [name for name, value in numbers.items() if not np.isfinite(value).all()]
    return f"{bad[0]} is not finite" if bad else ""


@promise("an episode ends in time")
def _ends(trial: Trial) -> str:
    decisions = trial.arena.timing.decisions
    late = WORLDS - int(trial.episode.seen.done[decisions].sum())
    return f"{late} of {WORLDS} worlds go on after {decisions} decisions" if late else ""


@promise("an end is terminated, truncated or void")
def _one_end(trial: Trial) -> str:
    seen = trial.episode.seen
    ends = np.sum([seen.verdict.terminated, seen.verdict.truncated, seen.void], axis=0)
    return "" if ends.max() <= 1 else "a world is two of them at once"


@promise("a verdict once given stays")
def _stays(trial: Trial) -> str:
    seen = trial.episode.seen
    verdict, over = seen.verdict, seen.done[:-1]
    outcome = (verdict.score, verdict.terminated, verdict.truncated, seen.void, seen.culprits)
    changed = [x[1:] != x[:-1] for x in outcome]
    changed += [x[1:] != 0 for terms in (verdict.rewards, verdict.shapings, verdict.events) for x in terms.values()]
    return "it changes after the end" if any(x[over].any() for x in changed) else ""


@promise("scores lie between 0 and 1, and two teams share 1")
def _scores(trial: Trial) -> str:
    seen = trial.episode.seen
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
    begun = trial.restart(trial.episode.last, trial.keys, jnp.ones(WORLDS, bool))
    return apart(view(begun), view(trial.first), 1e-5) or apart(view(trial.step(begun)), view(trial.second))


@promise("a restart leaves other worlds alone")
def _others(trial: Trial) -> str:
    kept = np.arange(WORLDS) % 2 == 0
    mixed = trial.restart(trial.second, trial.keys, jnp.asarray(~kept))
    return apart(view(mixed, kept), view(trial.second, kept), 1e-5)


@promise("a saved world goes on as it did")
def _saved(trial: Trial) -> str:
    arena = trial.arena
    saved = jax.device_get(jax.jit(jax.vmap(arena.save))(trial.second))
    loaded = jax.jit(jax.vmap(arena.load))(saved)
    exact = 0.0 if arena.engine.name in ("c", "none") else CLOSE
    return apart(view(loaded), view(trial.second), exact) or apart(
        view(trial.step(loaded, 1)), view(trial.step(trial.second, 1)), exact
    )


@promise("unstable physics makes a world void until its restart")
def _unstable(trial: Trial) -> str:
    if trial.arena.engine.name == "none":
        return ""
    physics, broken = trial.first.physics, np.arange(WORLDS) < 2
    speed = physics.qvel.at[0].set(jnp.nan).at[1].set(1e20)
    placed = trial.place(physics, physics.qpos, speed, jnp.asarray(broken), physics.model)
    after = trial.step(trial.first._replace(physics=placed))
    return _voided(trial, after, broken, "NaN in world 0 and 1e20 m/s in world 1 make these void")


@promise("wild actions make a world void and tell whose they were")
def _wild(trial: Trial) -> str:
    teams, actions = trial.arena.teams, trial.actions(0)
    actions |= {a.name: actions[a.name].at[0].set(jnp.nan) for a in teams[0].agents[:1]}
    actions |= {a.name: actions[a.name].at[1].set(jnp.inf) for a in teams[-1].agents[:1]}
    after = trial.act(trial.first, actions)
    culprits = np.zeros((WORLDS, len(teams)), bool)
    culprits[0, 0] = culprits[1, -1] = True
    if not np.array_equal(after.culprits, culprits):
        return f"culprits are {np.argwhere(after.culprits).tolist()}, not {np.argwhere(culprits).tolist()}"
    return _voided(trial, after, np.arange(WORLDS) < 2, "a NaN in world 0 and an infinity in world 1 make these void")


def _voided(trial: Trial, after: Any, broken: np.ndarray, what: str) -> str:
    """What is wrong with worlds after a decision in which those that are `broken` should have become void."""
    if not np.array_equal(after.void, broken):
        return f"{what}: {np.flatnonzero(after.void).tolist()}"
    if not all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves((after.observations, after.verdict))):
        return "void worlds show numbers that are not finite"
    begun = trial.restart(after, trial.keys, after.void)
    others = apart(view(after, ~broken), view(trial.second, ~broken))
    return others or apart(view(begun, broken), view(trial.first, broken), 1e-5)


@promise("scripts give fitting, finite actions")
def _scripts(trial: Trial) -> str:
    scripts = trial.arena.scripts()
    for name, agent in ((name, agent) for name in scripts for agent in trial.arena.agents):
        if agent.kind not in scripts[name]:
            continue
        action = jax.jit(jax.vmap(scripts[name][agent.kind]))(trial.second.observations[agent.name], trial.keys)
        if action.shape[1:] != (agent.action_size,) or not jnp.isfinite(action).all():
            return f"{name} tells {agent.name} {action.shape[1:]} numbers, not {agent.action_size} finite ones"
    return ""


@promise("frames are one control interval apart and add up to the verdict")
def _frames(trial: Trial) -> str:
    frames, timing, verdict = trial.frames, trial.arena.timing, trial.second.verdict
    due = timing.control_interval * np.arange(1, timing.hold + 1)
    if not np.allclose(frames.time, due, atol=1e-5):
        return "their times are not one control interval apart"
    parts, whole = {**frames.rewards, **frames.shapings}, {**verdict.rewards, **verdict.shapings}
    return apart({name: np.asarray(x).sum(axis=1) for name, x in parts.items()}, whole, 1e-5)


@promise("recorded frames are the states of the match")
def _recorded(trial: Trial) -> str:
    frames, physics = trial.recorded(), trial.by_hand()
    alive = trial.episode.seen.alive[: RECORDED + 1].all(axis=(0, 2))  # (WORLDS,): by hand nobody leaves the game
    return apart({"qpos": frames.qpos[:, alive]}, {"qpos": physics.qpos[:, alive]})


def config_hash(arena: Arena, settings: Any) -> str:
    """The configuration hash changes with each of the settings' rules, and with nothing when nothing changed."""
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
            return (1.1 * value + 0.01, *((0.9 * value, 2.0 * value) if value else ()))
        case (int() | float(), *_):
            return (tuple(1.1 * each for each in value),)
    return ()
