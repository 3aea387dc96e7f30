"""Arrays of a policy over skills: a *strategy* that commands frozen policies, its *skills*, every few decisions.

Such a policy is one flat dict of arrays, as any other. The strategy has the names of an `Actor`, and acts with one
number for each number of a command, and one more for each skill if there are several. Beside it are

| name | shape | |
|---|---|---|
| `skill.every` | () int32 | decisions for which a command is held |
| `skill.blend` | () int32 | 1: actions of several skills are averaged; 0: one skill is chosen |
| `skill.reach` | () | a number a of the strategy commands reach · clip(a, −1, 1), in the unit of the part |
| `skill.0.source` | (n,) int32 | for each input of the first skill its place in the observation; its size: none |
| `skill.0.target` | (n,) int32 | its place in the command; the size of the command: none |
| `skill.0.fill` | (n,) | the constant that is added to both |
| `skill.0.…` | | the skill's own network |

Without any skill the strategy's action is the robot's, and is held. This module loads NumPy alone.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

PREFIX = "skill."
INPUTS = ("source", "target", "fill")  # arrays that make a skill's input
COMMON = ("every", "blend", "reach")


class Skill(NamedTuple):
    """A frozen policy of one agent, and what it sees: see the table above."""

    network: Mapping[str, np.ndarray]
    source: np.ndarray  # (n,) int32
    target: np.ndarray  # (n,) int32
    fill: np.ndarray  # (n,) float32


def is_over_skills(arrays: Mapping[str, Any]) -> bool:
    """Return whether a policy is one over skills."""
    return f"{PREFIX}every" in arrays


def strategy_of(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arrays without those of skills: the strategy's own; of a policy without skills all of them."""
    return {name: array for name, array in arrays.items() if not name.startswith(PREFIX)}


def skill_count(arrays: Mapping[str, Any]) -> int:
    """Return the number of skills."""
    return sum(name.startswith(PREFIX) and name.endswith(".source") for name in arrays)


def skill_of(arrays: Mapping[str, Any], number: int) -> dict[str, Any]:
    """Return the arrays of one skill without their prefix: its network and `INPUTS`."""
    own = f"{PREFIX}{number}."
    return {name.removeprefix(own): array for name, array in arrays.items() if name.startswith(own)}


def choice_size(command: int, skills: int) -> int:
    """Return the numbers with which a strategy acts: those of a command, and a score for each of several skills."""
    return command + (skills if skills > 1 else 0)


def skill_arrays(skills: Sequence[Skill], every: int, reach: float, blend: bool) -> dict[str, np.ndarray]:
    """Return the arrays that a strategy's arrays are joined with to act over these skills."""
    found: dict[str, np.ndarray] = {
        f"{PREFIX}every": np.asarray(every, np.int32), f"{PREFIX}blend": np.asarray(blend, np.int32),
        f"{PREFIX}reach": np.asarray(reach, np.float32),
    }  # fmt: skip
    for i, skill in enumerate(skills):
        inputs = zip(INPUTS, (skill.source, skill.target, skill.fill), strict=True)
        found |= {f"{PREFIX}{i}.{name}": np.asarray(array) for name, array in (*inputs, *skill.network.items())}
    return found
