"""Terms of functions in files, built into an arena: rewards and observations, for one world, in JAX.

    def upright(arena, before, physics, game):           # a reward: (teams,) of one control step
    def time_left(arena, agent, physics, game, actions):  # an observation: (n,) or () of an agent

`before` and `physics` are the world before and after the control step, `game` is the game's own pytree, and `arena` has
queries such as `arena.body(agent, physics, actions)` and `arena.fallen(physics)`. As in all hooks of an arena, what a
function returns must follow from its arguments alone.
"""

import hashlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from arenas import python_file
from arenas.arena import Arena
from arenas.description import Legend, Part
from arenas.errors import TermError, describe_error, innermost_line
from arenas.games.terms import TermSpec
from arenas.physics.engine import Physics
from arenas.robots.robot import Script
from arenas.state import Verdict

ARGUMENTS = {
    "reward.terms": ("arena", "before", "physics", "game"),
    "observation_terms": ("arena", "agent", "physics", "game", "actions"),
}
"""Arguments of the functions, by setting."""


def add_terms(arena: Arena, rewards: Sequence[TermSpec], observations: Sequence[TermSpec]) -> None:
    """Build terms into an arena, and try each on shapes alone. Raises TermError, one line, for one that fails.

    Observations count for the arena's configuration hash, with the bytes of their files. Rewards do not, as no weight
    of a reward does: matches are decided by score.
    """
    before = jax.eval_shape(arena.reset, jax.random.key(0))
    if observations:
        _add_observations(arena, observations, (before.physics, before.game, before.actions))
    if rewards:
        _add_rewards(arena, rewards, before.verdict)
    jax.eval_shape(arena.reset, jax.random.key(0))


def _add_rewards(arena: Arena, terms: Sequence[TermSpec], shapes: Verdict) -> None:
    judge, legend, teams = arena.judge, arena.legend, len(arena.teams)
    functions = [(term, _loaded(term, "reward.terms")) for term in terms]
    dense = {term.name for term in terms if term.name in shapes.shapings}
    dense |= {term.name for term in terms if term.shaping and term.name not in shapes.rewards}

    def judged(before: Physics, physics: Physics, game: Any) -> tuple[Any, Verdict]:
        after, verdict = judge(before, physics, game)
        rewards, shapings = dict(verdict.rewards), dict(verdict.shapings)
        for term, function in functions:
            value = _called(term, "reward.terms", function, arena, before, physics, after)
            if value.shape != (teams,):
                raise _fault(
                    term,
                    "reward.terms",
                    f"it returns shape {value.shape} and not one number per team, ({teams},){_line(term, function)}",
                )
            (shapings if term.name in dense else rewards)[term.name] = term.weight * value
        return after, verdict._replace(rewards=rewards, shapings=shapings)

    def described() -> Legend:
        found = legend()
        if not (found.score or found.rewards or found.shapings):
            return found
        texts = {term.name: f"{term.weight:g} × {term.where}" for term in terms}
        own = {name: text for name, text in texts.items() if name in dense}
        return replace(
            found, rewards={**found.rewards, **{n: t for n, t in texts.items() if n not in dense}},
            shapings={**found.shapings, **own},
        )  # fmt: skip

    arena.judge, arena.legend = judged, described  # type: ignore[method-assign]


def _add_observations(arena: Arena, terms: Sequence[TermSpec], shapes: tuple[Any, Any, Any]) -> None:
    observe, size_of, parts_of, scripts_of = (
        arena.observe, arena.observation_size, arena.observation_parts, arena.scripts
    )  # fmt: skip
    functions = [(term, _loaded(term, "observation_terms")) for term in terms]
    layouts = {}  # agent -> (term, function, first number, or None where it follows, size)
    for agent in arena.robots:
        known = _places(parts_of(agent))
        layouts[agent] = [_layout(arena, agent, *each, known.get(each[0].name), shapes) for each in functions]

    own: dict[str, dict[int, int]] = {}  # kind -> size with the terms -> size without

    def observed(physics: Physics, game: Any, actions: dict[str, Array]) -> dict[str, Array]:
        found = dict(observe(physics, game, actions))
        for agent, layout in layouts.items():
            for term, function, first, _ in layout:
                value = _called(term, "observation_terms", function, arena, agent, physics, game, actions).reshape(-1)
                seen = found[agent]
                found[agent] = (
                    jnp.concatenate([seen, value]) if first is None
                    else jax.lax.dynamic_update_slice(seen, value.astype(seen.dtype), (first,))
                )  # fmt: skip
        return found

    def size(agent: str) -> int:
        return size_of(agent) + sum(n for _, _, first, n in layouts[agent] if first is None)

    def parts(agent: str) -> tuple[Part, ...]:
        found = parts_of(agent)
        texts = {term.name: Part(term.name, n, "", term.where) for term, _, _, n in layouts[agent]}
        # What is about the opponent stays so in another form: `league exploit --mask-opponent` freezes it.
        kept = tuple(texts[p.name]._replace(opponent=p.opponent) if p.name in texts else p for p in found)
        return kept + tuple(texts[t.name] for t, _, first, _ in layouts[agent] if first is None) if found else ()

    def scripts() -> dict[str, dict[str, Script]]:
        return {
            name: {kind: _without_terms(script, own[kind]) for kind, script in kinds.items()}
            for name, kinds in scripts_of().items()
        }

    for agent, robot in arena.robots.items():
        own.setdefault(robot.kind, {})[size(agent)] = size_of(agent)
    arena.observe, arena.observation_size, arena.observation_parts = observed, size, parts  # type: ignore[method-assign]
    arena.scripts = scripts  # type: ignore[method-assign]
    vars(arena).pop("teams", None)
    files = [(term.name, term.function, hashlib.sha256(term.file.read_bytes()).hexdigest()) for term in terms]
    arena.config_hash = hashlib.sha256(f"{arena.config_hash} {files}".encode()).hexdigest()[:16]


def _without_terms(script: Script, own: Mapping[int, int]) -> Script:
    """Return a script that sees observations without the terms that follow them; `own` are their sizes without, by the
    sizes with terms.
    """
    return lambda observation, key: script(observation[: own[observation.shape[-1]]], key)


def _layout(
    arena: Arena, agent: str, term: TermSpec, function: Callable, known: tuple[int, int] | None, shapes: tuple
) -> tuple[TermSpec, Callable, int | None, int]:
    """Return a term of an agent with its first number (None: it follows the others) and its size."""
    asked = jax.eval_shape(lambda *given: _called(term, "observation_terms", function, arena, agent, *given), *shapes)
    if len(asked.shape) > 1 or asked.size == 0:
        raise _fault(term, "observation_terms", f"it returns shape {asked.shape} and not (n,){_line(term, function)}")
    if known is not None and known[1] != asked.size:
        sizes = f"it returns {asked.size} numbers, and the part of that name has {known[1]}"
        raise _fault(term, "observation_terms", f"{sizes}{_line(term, function)}")
    return term, function, None if known is None else known[0], int(asked.size)


def _places(parts: Sequence[Part]) -> dict[str, tuple[int, int]]:
    """Return the first number and the size of each part of an observation."""
    found, first = {}, 0
    for part in parts:
        found[part.name] = first, part.size
        first += part.size
    return found


def _loaded(term: TermSpec, setting: str) -> Callable[..., Any]:
    if not term.file.is_file():
        raise _fault(term, setting, "there is no such file")
    try:
        module = python_file(term.file)
    except (Exception, SystemExit) as error:
        raise _fault(term, setting, describe_error(error, [term.file.resolve()])) from error
    found = getattr(module, term.function, None)
    if not callable(found):
        own = [name for name, each in vars(module).items() if _line(term, each) and not name.startswith("_")]
        raise _fault(term, setting, f"the file has no function {term.function} (functions: {', '.join(own) or 'none'})")
    _check_arguments(term, setting, found)
    return found


def _check_arguments(term: TermSpec, setting: str, function: Callable[..., Any]) -> None:
    """Raise TermError for a function that cannot be called with what a term is given; some builtins do not tell."""
    given = ARGUMENTS[setting]
    try:
        signature = inspect.signature(function)
    except ValueError:
        return
    try:
        signature.bind(*given)
    except TypeError as error:
        needs = f"it takes {signature}, and must take ({', '.join(given)})"
        raise _fault(term, setting, f"{needs}{_line(term, function)}") from error


def _called(term: TermSpec, setting: str, function: Callable[..., Any], *given: Any) -> Array:
    try:
        value = jnp.asarray(function(*given))
    except Exception as error:
        own = [term.file.resolve()]
        place = "" if innermost_line(error, own) else _line(term, function)
        raise _fault(term, setting, f"{describe_error(error, own)}{place}") from error
    if not (jnp.issubdtype(value.dtype, jnp.number) or value.dtype == bool):
        raise _fault(term, setting, f"it returns {value.dtype}, and must return numbers{_line(term, function)}")
    return value.astype(jnp.float32)


def _line(term: TermSpec, function: Any) -> str:
    """Return where the term's file defines a function, as ` (terms.py:12)`; empty for all else."""
    code = getattr(inspect.unwrap(function), "__code__", None) if callable(function) else None
    if code is None or Path(code.co_filename).resolve() != term.file.resolve():
        return ""
    return f" ({term.file.name}:{code.co_firstlineno})"


def _fault(term: TermSpec, setting: str, what: str) -> TermError:
    return TermError(f"arena.{setting}: {term.name} = {term.where}: {what}")
