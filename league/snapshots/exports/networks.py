"""Description of the networks in a frozen policy's arrays, and the check that these arrays are of such networks."""

import re
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from agents.policy.skill_arrays import (
    COMMON,
    INPUTS,
    PREFIX,
    choice_size,
    is_over_skills,
    skill_count,
    skill_of,
    strategy_of,
)
from agents.settings import ACTIVATIONS
from arenas import rosters


def agents_of(found: Mapping[str, np.ndarray], roster: str) -> list[dict[str, Any]]:
    """Describe each agent's network, in the roster's order. Raises ValueError if the arrays do not fit a network."""
    agents, used = [], set()
    for number, agent in enumerate(rosters.roster_agents(roster)):
        if not (match := re.fullmatch(r"([^:+]+):(\d{1,9}):(\d{1,9})", agent)):
            raise ValueError(f"{agent!r} is no agent's kind with the sizes of its observation and action")
        kind, sees, acts = match[1], int(match[2]), int(match[3])
        own = {k.removeprefix(f"{number}/"): v for k, v in found.items() if k.startswith(f"{number}/")}
        used |= {f"{number}/{name}" for name in own}
        agents.append(_agent_of(own, f"agent {number}", kind, sees, acts))
    if unknown := sorted(found.keys() - used):
        raise ValueError(f"{unknown[0]} is a parameter of no agent of {roster}")
    return agents


def _agent_of(own: Mapping[str, np.ndarray], who: str, kind: str, sees: int, acts: int) -> dict[str, Any]:
    """Describe the policy of one agent, over skills or not. Raises ValueError if the arrays do not fit."""
    if not is_over_skills(own):
        return _network_of(own, who, kind, sees, acts)
    strategy = strategy_of(own)
    bias = strategy.get("mean.bias")
    choices = len(bias) if bias is not None and bias.ndim == 1 else acts
    about = _network_of(strategy, who, kind, sees, choices)
    if about.get("recurrent"):
        raise ValueError(f"{who} is a strategy over skills with a memory")
    count = skill_count(own)
    command = choices - choice_size(0, count)
    if command < 0 or (not count and choices != acts):
        raise ValueError(f"{who} acts with {choices} numbers over {count} skills")
    skills, known = [], {f"{PREFIX}{name}" for name in COMMON}
    for name in COMMON:
        _check_array(own, f"{PREFIX}{name}", (), np.float32 if name == "reach" else np.int32, who)
    for i in range(count):
        skill = skill_of(own, i)
        known |= {f"{PREFIX}{i}.{name}" for name in skill}
        inputs = len(skill["source"]) if skill["source"].ndim == 1 else 0
        for name, most in (("source", sees), ("target", command), ("fill", None)):
            _check_array(skill, name, (inputs,), np.float32 if most is None else np.int32, f"{who}'s skill {i}")
            if most is not None and not ((skill[name] >= 0) & (skill[name] <= most)).all():
                raise ValueError(f"{who}'s skill {i} has a {name} beyond {most}")
        network = {name: array for name, array in skill.items() if name not in INPUTS}
        skills.append(_network_of(network, f"{who}'s skill {i}", kind, inputs, acts))
    if unknown := sorted(own.keys() - strategy.keys() - known):
        raise ValueError(f"{who} has an unknown parameter {unknown[0]}")
    every, blend = int(own[f"{PREFIX}every"]), int(own[f"{PREFIX}blend"])
    if every < 1 or blend not in (0, 1):
        raise ValueError(f"{who} holds a command for {every} decisions, and blends {blend}")
    over = {"every": every, "blend": blend, "command": command, "choices": choices, "strategy": about, "skills": skills}
    return about | {"action": acts, "over": over}


def _check_array(own: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...], dtype: Any, who: str) -> None:
    """Raise ValueError unless there is an array of that name, shape and type, all of it finite."""
    if name not in own:
        raise ValueError(f"{who} has no parameter {name}")
    if own[name].shape != shape or own[name].dtype != dtype or not np.isfinite(own[name]).all():
        raise ValueError(f"{who}'s {name} is no {np.dtype(dtype).name} of the shape {shape}")


def _network_of(own: Mapping[str, np.ndarray], who: str, kind: str, sees: int, acts: int) -> dict[str, Any]:
    """Describe an actor's network. Raises ValueError if the arrays do not fit one."""
    hidden = []
    while (weight := own.get(f"trunk.hidden.{len(hidden)}.weight")) is not None and weight.ndim == 2:
        hidden.append(weight.shape[0])
    normed = "trunk.norm.0.weight" in own
    kinds = "deviation.weight" in own, "squash" in own
    gru = own.get("gru.weight_hh")
    units = gru.shape[-1] if gru is not None and gru.ndim == 2 else 0
    sets = _entity_sets(own, sees)
    wanted = _shapes(sees, acts, hidden, normed, *kinds, units, sets)
    for name in sorted(own.keys() ^ wanted.keys()):
        raise ValueError(f"{who} has {'an unknown' if name in own else 'no'} parameter {name}")
    for name, shape in wanted.items():
        if own[name].shape != shape:
            raise ValueError(f"{who}'s {name} has the shape {own[name].shape}, and {kind} needs {shape}")
        whole = name == "activation" or name.endswith((".index", ".own"))
        if own[name].dtype != (np.int32 if whole else np.float32):
            raise ValueError(f"{who}'s {name} is of type {own[name].dtype}")
        if not np.isfinite(own[name]).all():
            raise ValueError(f"{who}'s {name} is not finite")
    activation = int(own["activation"])
    if not 0 <= activation < len(ACTIVATIONS):
        raise ValueError(f"{who} has activation {activation}, which is none")
    return {
        "kind": kind, "observation": sees, "action": acts, "hidden": hidden,
        "activation": ACTIVATIONS[activation], "layer_norm": normed, "state_std": kinds[0],
        "squash": float(own["squash"]) if kinds[1] else None,
    } | ({"recurrent": units} if units else {}) | ({"entities": sets} if sets else {})  # fmt: skip


def _entity_sets(own: Mapping[str, np.ndarray], sees: int) -> list[list[int]]:
    """Return entities, numbers of each, and the encoder's width of each set (agents/policy/entities.py).

    Raises ValueError unless each of the `sees` places is in one entity or the agent's own.
    """
    found: list[list[int]] = []
    places = [np.asarray(own.get("trunk.own", np.zeros(0, np.int32))).reshape(-1)]
    while (index := own.get(f"trunk.entities.{len(found)}.index")) is not None:
        weight = own.get(f"trunk.entities.{len(found)}.layers.0.weight")
        if index.ndim != 2 or weight is None or weight.ndim != 2:
            raise ValueError(f"entities {len(found)} are no set with an encoder")
        found.append([*index.shape, weight.shape[0]])
        places.append(index.reshape(-1))
    if found and not np.array_equal(np.sort(np.concatenate(places)), np.arange(sees)):
        raise ValueError("its entities and own numbers are not those of its observation")
    return found


def _shapes(
    sees: int, acts: int, hidden: list[int], normed: bool, state_std: bool, squashed: bool, units: int,
    sets: list[list[int]],
) -> dict[str, tuple[int, ...]]:  # fmt: skip
    """Return shapes of an actor's parameters (agents/policy/networks.py) by name; `units` of its GRU, 0 without one."""
    own = sees - sum(count * size for count, size, _ in sets)
    widths = [own + 2 * sum(width for *_, width in sets), *hidden]
    last = units or widths[-1]
    shapes: dict[str, tuple[int, ...]] = {
        "activation": (), "std_scale": (),
        "mean.bias": (acts,), "mean.weight": (acts, last),
        "trunk.observation_mean": (sees,), "trunk.observation_var": (sees,), "trunk.observation_clip": (),
    }  # fmt: skip
    shapes |= {"trunk.own": (own,)} if sets else {}
    for i, (count, size, width) in enumerate(sets):
        of_set = {"index": (count, size), "layers.0.weight": (width, size), "layers.1.weight": (width, width)}
        of_set |= {"layers.0.bias": (width,), "layers.1.bias": (width,)}
        shapes |= {f"trunk.entities.{i}.{name}": shape for name, shape in of_set.items()}
    deviation = {"deviation.bias": (acts,), "deviation.weight": (acts, last)}
    shapes |= deviation if state_std else {"std_logit": (acts,)}
    shapes |= {"squash": ()} if squashed else {}
    if units:
        shapes |= {f"gru.bias_{of}": (3 * units,) for of in ("ih", "hh")}
        shapes |= {"gru.weight_ih": (3 * units, widths[-1]), "gru.weight_hh": (3 * units, units)}
        shapes |= {"gru.norm.weight": (units,), "gru.norm.bias": (units,)} if normed else {}
    for i, (before, after) in enumerate(pairwise(widths)):
        shapes |= {f"trunk.hidden.{i}.weight": (after, before), f"trunk.hidden.{i}.bias": (after,)}
    for i, width in enumerate(widths if normed else ()):
        shapes |= {f"trunk.norm.{i}.weight": (width,), f"trunk.norm.{i}.bias": (width,)}
    return shapes


def memory_units(agent: Mapping[str, Any]) -> int:
    """Return the size of what a policy, by its description, remembers: 0 if nothing."""
    return 1 + agent["over"]["choices"] if "over" in agent else agent.get("recurrent", 0)


def noise_size(agent: Mapping[str, Any]) -> int:
    """Return the size of a program's noise: that of actions, or of a strategy's choices if those are more."""
    return max(agent["action"], agent["over"]["choices"]) if "over" in agent else agent["action"]
