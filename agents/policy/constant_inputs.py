"""Inputs that were constant where a network learnt, and their effect in an arena where they vary.

Quantities that an arena lacks are constant there. The normaliser turns them into 0, so their weights keep their initial
values. If they then vary in another arena, their tiny standard deviation would scale them up to the clip limit and make
the policy a new one. In another arena the weights of such inputs are therefore set to 0 and their variance to 1: while
the inputs are constant the network stays the same. Behind a LayerNorm weights matter even for constant inputs, and
stay. So do, in a skill, the inputs that a strategy commands: it learnt with their effect.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from agents.policy.skill_arrays import PREFIX, choice_size, skill_count

CONSTANT = 1e-6  # variance below which an input counts as constant, up to rounding


def is_constant(arrays: Mapping[str, np.ndarray], of: str = "") -> np.ndarray:
    """Return a mask (n,) bool of the constant inputs of the network whose arrays begin with `of`."""
    return np.asarray(arrays[f"{of}trunk.observation_var"]) < CONSTANT


def has_input_norm(arrays: Mapping[str, np.ndarray], of: str = "") -> bool:
    """Return True if that network normalises its input by a LayerNorm."""
    return f"{of}trunk.norm.0.weight" in arrays


def silence_constant_inputs(arrays: Mapping[str, np.ndarray], of: str = "") -> dict[str, np.ndarray]:
    """Return the arrays of that network for use in another arena: constant inputs have no effect.

    Of a policy over skills they have none in its skills either.
    """
    new = _silenced(arrays, of, is_constant(arrays, of))
    skills = f"{of}{PREFIX}"
    count = skill_count({name.removeprefix(of): array for name, array in arrays.items() if name.startswith(skills)})
    for network in (f"{skills}{number}." for number in range(count)):
        commands = len(arrays[f"{of}mean.bias"]) - choice_size(0, count)
        own = np.asarray(arrays[f"{network}target"]) >= commands  # the others are commanded
        new = _silenced(new, network, is_constant(arrays, network) & own)
    return new


def _silenced(arrays: Mapping[str, np.ndarray], of: str, constant: np.ndarray) -> dict[str, np.ndarray]:
    """Return the arrays, in which these inputs (n,) bool of a network have no effect."""
    new = dict(arrays)
    variance, weights = f"{of}trunk.observation_var", f"{of}trunk.hidden.0.weight"
    new[variance] = np.where(constant, np.ones_like(arrays[variance]), arrays[variance])
    own = np.asarray(arrays.get(f"{of}trunk.own", np.arange(len(constant))))
    firsts: list[tuple[str, Any]] = [] if has_input_norm(arrays, of) else [(weights, constant[own])]
    for index in (name for name in arrays if name.startswith(f"{of}trunk.entities.") and name.endswith(".index")):
        of_set = constant[np.asarray(arrays[index])].all(axis=0)  # entities of a set share their statistics
        firsts.append((f"{index.removesuffix('index')}layers.0.weight", of_set))
    for name, still in firsts:
        silent = np.array(arrays[name])
        silent[:, : len(still)][:, still] = 0.0
        new[name] = silent
    return new
