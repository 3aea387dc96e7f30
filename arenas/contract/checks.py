"""The checks of the contract, one function each. Each describes the arena's fault, or returns an empty string."""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from arenas.arena import Arena
from arenas.contract import entity_check, exchange_check
from arenas.contract.check_run import CLOSE, RECORDED, WORLDS, CheckRun, arrays_of, difference
from arenas.errors import ArenaError
from arenas.robots.robot import is_choice
from arenas.state import State

Problem = Callable[[CheckRun], str]
CHECKS: dict[str, Problem] = {}


def check(name: str) -> Callable[[Problem], Problem]:
    """Add a function to CHECKS under this name. The function describes the fault, or returns an empty string."""

    def listed(problem: Problem) -> Problem:
        CHECKS[name] = problem
        return problem

    return listed


def reset_and_step(run: CheckRun) -> str:
    """Reset the worlds and take one decision. Raises the error of the arena's own code, if any."""
    jax.block_until_ready((run.first, run.second))
    return ""


@check("agents are named team/index, as are their bodies")
def _names(run: CheckRun) -> str:
    arena, agents = run.arena, [agent.name for agent in run.arena.agents]
    bodies = [arena.scene.model.body(i).name for i in range(arena.scene.model.nbody)]
    if agents != [f"{team.name}/{i}" for team in arena.teams for i in range(len(team.agents))]:
        return f"agents {agents}"
    bare = [n for n in agents if arena.robots[n].build and not any(body.startswith(f"{n}/") for body in bodies)]
    return f"no body of the model begins with {bare[0]}/" if bare else ""


@check("observations are finite")
def _observations(run: CheckRun) -> str:
    """Examine worlds with sound physics: a decided game is not void, and its physics may fail until the restart."""
    raw, sound = run.episode.raw, ~(run.episode.states.void | run.episode.unstable)
    for agent, values in raw.items():
        bad = ~np.isfinite(values[sound]).all(axis=0)  # (obs,)
        if bad.any():
            return f"{agent} observes numbers that are not finite, at index {', '.join(map(str, np.flatnonzero(bad)))}"
    return ""


CHECKS["exchangeable teams observe, earn and score alike on both sides"] = exchange_check.problem


@check("reset and step give states of one shape")
def _shapes(run: CheckRun) -> str:
    one, other = (jax.tree.map(lambda x: (x.shape, x.dtype), state) for state in (run.first, run.second))
    return "" if one == other else "lax.scan needs the state after a step to be shaped as after reset"


@check("an agent that is out of the game neither acts nor observes")
def _out_of_the_game(run: CheckRun) -> str:
    """Change the actions of agents that are out of the game, in the first decision of random play that has any."""
    states, agents = run.episode.states, run.arena.agents
    out = ~states.alive & ~states.done[..., None]  # (T, WORLDS, agents)
    for i, agent in enumerate(agents):
        if states.observations[agent.name][out[..., i]].any():
            return f"{agent.name} observes something while it is out of the game"
    if not out.any():
        return ""
    at, state = int(np.argwhere(out)[0, 0]), run.first
    for decision in range(at):
        state = run.step(state, decision)
    actions = run.actions(at)
    non_finite = {a.name: jnp.where(out[at][:, i, None], jnp.nan, actions[a.name]) for i, a in enumerate(agents)}
    return difference(arrays_of(run.act(state, non_finite)), arrays_of(run.act(state, actions)))


@check("rewards, shapings and scores are finite")
def _verdicts(run: CheckRun) -> str:
    verdict = run.episode.states.verdict
    numbers = {**verdict.rewards, **verdict.shapings, "score": verdict.score}
    bad = [name for name, value in numbers.items() if not np.isfinite(value).all()]
    return f"{bad[0]} is not finite" if bad else ""


@check("an episode ends in time")
def _ends(run: CheckRun) -> str:
    decisions = run.arena.timing.decisions
    late = WORLDS - int(run.episode.states.done[decisions].sum())
    return f"{late} of {WORLDS} worlds go on after {decisions} decisions" if late else ""


@check("an end is terminated, truncated or void")
def _one_end(run: CheckRun) -> str:
    states = run.episode.states
    ends = np.sum([states.verdict.terminated, states.verdict.truncated, states.void], axis=0)
    return "" if ends.max() <= 1 else "a world is two of them at once"


@check("a verdict is final")
def _stays(run: CheckRun) -> str:
    states = run.episode.states
    verdict, over = states.verdict, states.done[:-1]
    outcome = (verdict.score, verdict.terminated, verdict.truncated, states.void, states.at_fault)
    changed = [x[1:] != x[:-1] for x in outcome]
    changed += [x[1:] != 0 for terms in (verdict.rewards, verdict.shapings, verdict.events) for x in terms.values()]
    return "it changes after the end" if any(x[over].any() for x in changed) else ""


@check("scores lie between 0 and 1, and two teams share 1; those of more teams rank them")
def _scores(run: CheckRun) -> str:
    states = run.episode.states
    score = states.verdict.score[-1][states.done[-1] & ~states.void[-1]]  # (ended worlds, teams)
    if score.size == 0:
        return "no episode of random play ended with a score"
    if score.shape[1] > 2:
        return "" if np.isfinite(score).all() else f"scores {np.unique(score, axis=0).tolist()}"
    fair = score.shape[1] != 2 or np.allclose(score.sum(axis=1), 1.0)
    return "" if fair and score.min() >= 0 and score.max() <= 1 else f"scores {np.unique(score, axis=0).tolist()}"


@check("the key decides everything")
def _reproducible(run: CheckRun) -> str:
    again = run.reset(run.keys)
    same = difference(arrays_of(again), arrays_of(run.first), 0.0)
    return same or difference(arrays_of(run.step(again)), arrays_of(run.second))


@check("worlds do not influence each other")
def _independent(run: CheckRun) -> str:
    order = np.roll(np.arange(WORLDS)[::-1], 3)
    shuffled = run.step(run.reset(run.keys[order]), order=order)
    return difference(arrays_of(shuffled), arrays_of(run.second, order))


@check("a restarted world equals a new one")
def _restarted(run: CheckRun) -> str:
    begun = run.restart(run.episode.last, run.keys, jnp.ones(WORLDS, bool))
    return difference(arrays_of(begun), arrays_of(run.first), 1e-5) or difference(
        arrays_of(run.step(begun)), arrays_of(run.second)
    )


@check("a restart leaves other worlds unchanged")
def _untouched(run: CheckRun) -> str:
    kept = np.arange(WORLDS) % 2 == 0
    mixed = run.restart(run.second, run.keys, jnp.asarray(~kept))
    return difference(arrays_of(mixed, kept), arrays_of(run.second, kept), 1e-5)


@check("a saved world continues unchanged")
def _saved(run: CheckRun) -> str:
    arena = run.arena
    saved = jax.device_get(jax.jit(jax.vmap(arena.save))(run.second))
    loaded = jax.jit(jax.vmap(arena.load))(saved)
    exact = 0.0 if arena.engine.name in ("c", "none") else CLOSE
    return difference(arrays_of(loaded), arrays_of(run.second), exact) or difference(
        arrays_of(run.step(loaded, 1)), arrays_of(run.step(run.second, 1)), exact
    )


@check("unstable physics makes a world void until its restart")
def _unstable(run: CheckRun) -> str:
    if run.arena.engine.name == "none":
        return ""
    physics, broken = run.first.physics, np.arange(WORLDS) < 2
    speed = physics.qvel.at[0].set(jnp.nan).at[1].set(1e20)
    placed = run.place(physics, physics.qpos, speed, jnp.asarray(broken), physics.model)
    after = run.step(run.first._replace(physics=placed))
    return _voided(run, after, broken, "NaN in world 0 and 1e20 m/s in world 1 make these void")


@check("non-finite actions make a world void and identify the team")
def _non_finite_actions(run: CheckRun) -> str:
    teams, actions, at_fault = run.arena.teams, run.actions(0), np.zeros((WORLDS, len(run.arena.teams)), bool)
    names = [agent.name for agent in run.arena.agents]
    for team, number in ((0, jnp.nan), (len(teams) - 1, jnp.inf)):
        agent = teams[team].agents[0].name
        free = np.asarray(run.first.alive[:, names.index(agent)]) & ~at_fault.any(axis=1)
        world = int(free.argmax())  # the first in which it is the agent's turn
        actions[agent] = actions[agent].at[world].set(number)
        at_fault[world, team] = free[world]
    after = run.act(run.first, actions)
    if not np.array_equal(after.at_fault, at_fault):
        return f"teams at fault are {np.argwhere(after.at_fault).tolist()}, not {np.argwhere(at_fault).tolist()}"
    return _voided(run, after, np.any(at_fault, 1), "a NaN in one world and an infinity in another make these void")


def _voided(run: CheckRun, after: Any, broken: np.ndarray, what: str) -> str:
    """Describe the fault if other worlds than the `broken` ones are void after a decision."""
    if not np.array_equal(after.void, broken):
        return f"{what}: {np.flatnonzero(after.void).tolist()}"
    if not all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves((after.observations, after.verdict))):
        return "void worlds show numbers that are not finite"
    begun = run.restart(after, run.keys, after.void)
    others = difference(arrays_of(after, ~broken), arrays_of(run.second, ~broken))
    return others or difference(arrays_of(begun, broken), arrays_of(run.first, broken), 1e-5)


CHECKS["entities are sets: their order means nothing to scripts"] = entity_check.problem


@check("a first decision sets what its agent declares, and later ones nothing")
def _designs(run: CheckRun) -> str:
    still = {agent.name: jnp.zeros((WORLDS, agent.action_size)) for agent in run.arena.agents}
    for agent, robot in run.arena.robots.items():
        if robot.sets and len(robot.sets) != robot.action_size:
            return f"{agent} sets {len(robot.sets)} things, with {robot.action_size} numbers of an action"
        for i, (name, bounds) in enumerate(robot.sets.items()):
            if is_choice(bounds):
                if len(set(bounds)) < max(2, len(bounds)):
                    return f"{agent} chooses {name} among {', '.join(map(str, bounds))}: it needs two names or more"
            elif not -np.inf < float(bounds[0]) <= float(bounds[1]) < np.inf:
                return f"{agent} sets {name} from {bounds[0]} to {bounds[1]}"
            ends = [{**still, agent: still[agent].at[:, i].set(end)} for end in (-1.0, 1.0)]
            low, high = (run.act(run.first, actions) for actions in ends)
            if bounds[0] != bounds[1] and not difference(_physics_of(low), _physics_of(high), 0.0):
                return f"{agent} sets {name}, and the world is the same with {bounds[0]} and {bounds[-1]}"
            later = run.act(low, ends[1]).physics.model
            if changed := difference(low.physics.model, later, 0.0):
                return f"{agent} sets {name} also in its second decision: {changed}"
    return ""


def _physics_of(state: State) -> dict[str, np.ndarray]:
    return {name: values for name, values in arrays_of(state).items() if name.startswith("physics")}


@check("scripts return finite actions of the right size")
def _scripts(run: CheckRun) -> str:
    scripts = run.arena.scripts()
    for name, agent in ((name, agent) for name in scripts for agent in run.arena.agents):
        if agent.kind not in scripts[name]:
            continue
        action = jax.jit(jax.vmap(scripts[name][agent.kind]))(run.second.observations[agent.name], run.keys)
        if action.shape[1:] != (agent.action_size,) or not jnp.isfinite(action).all():
            return f"{name} gives {agent.name} {action.shape[1:]} numbers, not {agent.action_size} finite ones"
    return ""


@check("frames are one control interval apart and add up to the verdict")
def _frames(run: CheckRun) -> str:
    frames, timing, verdict = run.frames, run.arena.timing, run.second.verdict
    due = timing.control_interval * np.arange(1, timing.hold + 1)
    if not np.allclose(frames.time, due, atol=1e-5):
        return "their times are not one control interval apart"
    parts, whole = {**frames.rewards, **frames.shapings}, {**verdict.rewards, **verdict.shapings}
    return difference({name: np.asarray(x).sum(axis=1) for name, x in parts.items()}, whole, 1e-5)


@check("recorded frames are the states of the match")
def _recorded(run: CheckRun) -> str:
    frames, physics = run.recorded_frames(), run.stepped_physics()
    alive = run.episode.states.alive[: RECORDED + 1].all(axis=(0, 2))  # (WORLDS,): `stepped_physics` removes no agents
    return difference({"qpos": frames.qpos[:, alive]}, {"qpos": physics.qpos[:, alive]})


def config_hash(arena: Arena, settings: Any) -> str:
    """Check that the configuration hash changes with each of the settings' rules, and only then."""
    if settings.build(engine="c").config_hash != arena.config_hash:
        return "the same settings give another hash"
    rules: Any = getattr(settings, "rules", None)
    for field in fields(rules) if rules else ():
        for other in _nearby_values(getattr(rules, field.name)):
            try:
                changed = replace(settings, rules=replace(rules, **{field.name: other})).build(engine="c")
            except (ValueError, ArenaError):
                continue  # the rules do not allow this value
            if changed.config_hash == arena.config_hash:
                return f"rules.{field.name} = {other} does not change it"
    return ""


def _nearby_values(value: Any) -> tuple:
    """Return other values of a rule; the rules may not allow all of them."""
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
