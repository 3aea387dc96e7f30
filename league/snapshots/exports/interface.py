"""Inputs and outputs of a frozen policy, for its model card: units, ranges, rates, and a few lines of NumPy."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from arenas.description import Outline, Part, with_indices
from arenas.rosters import bare
from dashboards.untrusted_text import visible
from league.snapshots.exports.networks import memory_units, noise_size
from league.snapshots.exports.numpy_export import numpy_lines
from league.snapshots.policy_file import Policy
from league.snapshots.transfer.arena_transfer import Played
from league.snapshots.transfer.home_arena import described_arena

if TYPE_CHECKING:
    from arenas.arena import Arena

DEVIATIONS = 2.0  # beside the mean, of the range that a card tells
UNNAMED = "The meaning of its numbers is not known here: "


def section(policy: Policy, file: str, programs: Mapping[int, Sequence[str]], played: Played) -> str:
    """Return the end of a model card, as Markdown.

    The units and meanings of numbers come from the arena, which is built only for a card of programs: it takes seconds.

    Args:
        policy: the policy.
        file: the name of its safetensors file.
        programs: by agent, the names of the ONNX and TorchScript files that were written beside it.
        played: the policy as its league plays it.
    """
    learnt = (policy.about["arena"] or {}).get("arena")
    command = f", and `league arenas {visible(learnt)}` tells it" if learnt else ""
    arena, why = None, f"`league export --onnx` writes a card with it{command}."
    if programs:
        arena, error = described_arena(policy.about["settings"])
        why = f"its arena cannot be built from its settings ({visible(error)})."
    blocks = ["## What it sees and does", played.note]
    if arena is None:
        blocks.append(UNNAMED + why)
    else:
        from league.queries.arena_info import timing

        blocks.append(f"Its rate: {timing(Outline('', {}, arena.timing))}")
    for number, agent in enumerate(policy.about["agents"]):
        own = {k.partition("/")[2]: v for k, v in policy.arrays.items() if k.startswith(f"{number}/")}
        sees, acts = _parts(arena, policy.about["roster"], number, agent)
        blocks += [f"### Agent {number}, {agent['kind']}", _ends(agent, programs.get(number, ()))]
        if arena is not None:
            blocks += [_table("it sees", sees, _seen(own)), _table("it does", acts, _done(agent)), _range(own)]
        blocks += _code(agent, number, file, played.silenced)
    return "\n" + "\n\n".join(filter(None, blocks)) + "\n"


def _parts(
    arena: "Arena | None", roster: str, number: int, agent: Mapping[str, Any]
) -> tuple[tuple[Part, ...], tuple[Part, ...]]:
    """Return the parts of an agent's observation and action; unnamed ones where its arena does not tell them."""
    sees, acts = (Part("unnamed", agent["observation"]),), (Part("unnamed", agent["action"]),)
    teams = [] if arena is None else [t for t in arena.teams if bare(t.roster) == bare(roster)]
    if arena is None or not teams:
        return sees, acts
    name = min(teams, key=lambda team: team.roster != roster).agents[number].name
    return arena.observation_parts(name) or sees, arena.robots[name].action_parts or acts


def _ends(agent: Mapping[str, Any], files: Sequence[str]) -> str:
    """Describe inputs and outputs of the files."""
    units = memory_units(agent)
    named = " and ".join(f"`{file}`" for file in files) or "an ONNX or TorchScript file (`league export --onnx`)"
    rows = [
        ("in", "observations", agent["observation"], "as below; normalisation is inside"),
        (
            "in",
            "noise",
            noise_size(agent),
            "zeros for the mean action; standard normal numbers to explore as in the league",
        ),
        *([("in", "memory", units, "zeros where an episode begins, then `next_memory`")] if units else []),
        ("out", "actions", agent["action"], "as below; scaling is inside"),
        *([("out", "next_memory", units, "the memory of the next decision")] if units else []),
    ]
    head = f"Inputs and outputs of {named}, all float32 for N worlds:"
    lines = [f"| {way} | `{name}` | (N, {size}) | {what} |" for way, name, size, what in rows]
    return "\n".join([head, "", "| | name | shape | |", "|---|---|---|---|", *lines])


def _table(title: str, parts: Sequence[Part], ranges: np.ndarray) -> str:
    """Return a table of parts; `ranges` (2, n) are the least and the most of each number."""
    rows, at = [f"| {title} | index | unit | range | meaning |", "|---|---|---|---|---|"], 0
    for place, part in with_indices(parts):
        low, high = ranges[0, at : at + part.size].min(), ranges[1, at : at + part.size].max()
        bounds = f"{low:.3g} to {high:.3g}" if np.isfinite(high - low) else "any"
        at += part.size
        words = (visible(text).replace("|", "\\|") for text in (part.name, place, part.unit, bounds, part.meaning))
        rows.append(f"| {' | '.join(words)} |")
    return "\n".join(rows)


def _seen(own: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the usual range (2, obs) of observations while it learnt; infinite if it keeps no statistics."""
    mean, deviation = own["trunk.observation_mean"], np.sqrt(own["trunk.observation_var"])
    if not _normalises(own):
        return np.stack([np.full_like(mean, -np.inf), np.full_like(mean, np.inf)])
    return np.stack([mean - DEVIATIONS * deviation, mean + DEVIATIONS * deviation])


def _done(agent: Mapping[str, Any]) -> np.ndarray:
    limit = np.inf if agent["squash"] is None else agent["squash"]
    return np.tile([[-limit], [limit]], agent["action"])


def _range(own: Mapping[str, np.ndarray]) -> str:
    if not _normalises(own):
        return "It does not normalise observations. An action without a range is clipped by the robot, if at all."
    return (
        f"The range of observations is that of {DEVIATIONS:g} standard deviations about the mean while it learnt;"
        f" beyond {float(own['trunk.observation_clip']):g} deviations it clips. An action without a range is clipped by"
        " the robot, if at all."
    )


def _normalises(own: Mapping[str, np.ndarray]) -> bool:
    return bool(own["trunk.observation_clip"] < 1e30)


def _code(agent: Mapping[str, Any], number: int, file: str, silenced: bool) -> Iterator[str]:
    """Yield the policy in NumPy; of one over skills, that its programs are the way to run it."""
    if "over" in agent:
        yield "It acts over skills, which the safetensors file holds with it; run its ONNX or TorchScript file."
        return
    yield "The same in NumPy, from the safetensors file:"
    yield "\n".join(["```python", *numpy_lines(agent, number, file, silenced), "```"])
