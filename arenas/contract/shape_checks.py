"""Check that a game's hooks return arrays of the declared names, shapes and types."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena import Arena
from arenas.contract.check_run import CheckRun
from arenas.rosters import NAME
from arenas.state import Verdict

MARKERS = {"circle": 3, "segment": 6, "sphere": 4, "ball": 4}  # numbers per marker kind


def check_shapes(run: CheckRun) -> str:
    """Check the hooks' direct results: later, masks and sums would hide faults. Empty if all is well."""
    arena = run.arena
    physics, game = jax.eval_shape(lambda key: _start(arena, key), run.key)
    model = arena.scene.model
    if (physics.qpos.shape, physics.qvel.shape) != ((model.nq,), (model.nv,)):
        return f"place gives {physics.qpos.shape} and {physics.qvel.shape}, not ({model.nq},) and ({model.nv},)"
    actions = {agent.name: jnp.zeros(agent.action_size) for agent in arena.agents}
    observations = jax.eval_shape(arena.observe, physics, game, actions)
    if set(observations) != set(actions):
        return f"observations are of {sorted(observations)}, agents are {sorted(actions)}"
    due = {agent.name: ((agent.observation_size,), "float32") for agent in arena.agents}
    after, verdict = jax.eval_shape(arena.judge, physics, physics, game)
    if jax.tree.map(_shape, after) != jax.tree.map(_shape, game):
        return "judge gives the game's pytree another shape than place"
    alive = jax.eval_shape(arena.alive, physics, game)
    if _shape(alive) != ((len(arena.agents),), "bool"):
        return f"alive gives {alive.dtype} {alive.shape}, not bool ({len(arena.agents)},)"
    if arena.privileged_size:
        whole = {"state": jax.eval_shape(arena.privileged, physics, game, actions)}
        problem = _wrong("the privileged", whole, {"state": ((arena.privileged_size,), "float32")})
        if problem:
            return f"{problem} as privileged_parts has it"
    kinds, drawn = arena.marker_kinds, jax.eval_shape(arena.markers, physics, game)
    if set(kinds) != set(drawn) or set(kinds.values()) - set(MARKERS):
        return f"markers {sorted(drawn)} declared as {dict(kinds)}; kinds: {', '.join(MARKERS)}"
    return (
        _wrong("the observation of", observations, due)
        or _verdict(verdict, len(arena.teams))
        or _wrong("marker", drawn, {name: ((MARKERS[kinds[name]],), "float32") for name in kinds})
    )


def _start(arena: Arena, key: Array) -> tuple[Any, Any]:
    qpos, qvel, game = arena.place(key)
    return arena.engine.make(qpos, qvel, arena.randomise(key))._replace(carry=()), game


def _verdict(verdict: Verdict, teams: int) -> str:
    """Describe a wrong shape, type or name in a verdict; empty if there is none."""
    terms = {"reward": verdict.rewards, "shaping": verdict.shapings, "event": verdict.events}
    for what, named in terms.items():
        bad = [name for name in named if not NAME.fullmatch(name)]
        if bad:
            return f"{what} {bad[0]!r} needs a name of letters, digits, - and _"
        problem = _wrong(what, named, dict.fromkeys(named, ((teams,), "bool" if what == "event" else "float32")))
        if problem:
            return problem
    rest = {"score": verdict.score, "terminated": verdict.terminated, "truncated": verdict.truncated}
    due = {"score": ((teams,), "float32"), "terminated": ((), "bool"), "truncated": ((), "bool")}
    return _wrong("the verdict's", rest, due)


def _wrong(what: str, found: Mapping[str, Any], due: Mapping[str, tuple]) -> str:
    for name, value in found.items():
        if _shape(value) != due[name]:
            (shape, kind), (due_shape, due_kind) = _shape(value), due[name]
            return f"{what} {name} is {kind} {shape}, not {due_kind} {due_shape}"
    return ""


def _shape(value: Any) -> tuple[tuple[int, ...], str]:
    return tuple(value.shape), str(value.dtype)
