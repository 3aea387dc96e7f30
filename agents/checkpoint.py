"""A learner's state as named arrays: writing it, reading it back, and what is refused."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from agents.errors import Diverged

State = Mapping[str, np.ndarray]
CONSTANT = 1e-6  # an observation with less variance has not moved, but for rounding
NETWORKS = ("actor.", "critic.")  # what begins so is a network's: one number too many is another network


def write(tensors: Mapping[str, Tensor], rng: torch.Generator) -> dict[str, np.ndarray]:
    """Copies of all tensors, and the state of the random numbers."""
    arrays = {name: tensor.detach().cpu().numpy().copy() for name, tensor in tensors.items()}
    return {**arrays, "rng": rng.get_state().numpy().copy()}


def read(tensors: Mapping[str, Tensor], fixed: Collection[str], rng: torch.Generator, state: State) -> None:
    """Write a state over the tensors and the random numbers.

    `fixed` names what a state must agree in, as activation functions. Raises ValueError naming what is missing, of
    another shape, not known here or not finite; then nothing changed.
    """
    wrong = [k for k, t in tensors.items() if k not in state or np.shape(state[k]) != tuple(t.shape)]
    wrong += [k for k in fixed if k not in wrong and not np.array_equal(state[k], tensors[k].cpu().numpy())]
    wrong += [k for k in state if k not in tensors and k.startswith(NETWORKS)]
    wrong += ["rng"] if "rng" not in state else []
    if wrong:
        told = f"{', '.join(wrong[:3])} ({len(wrong)} in all)"
        raise ValueError(f"the checkpoint does not fit this learner: {told}; {_unlike(wrong[0], tensors, state)}")
    bad = [k for k in tensors if not np.isfinite(state[k]).all()]
    if bad:
        raise ValueError(f"the checkpoint is not finite in {', '.join(bad[:3])} ({len(bad)} in all)")
    with torch.no_grad():
        for name, tensor in tensors.items():
            tensor.copy_(torch.from_numpy(np.array(state[name])))
    rng.set_state(torch.from_numpy(np.array(state["rng"])))


def _unlike(name: str, tensors: Mapping[str, Tensor], state: State) -> str:
    """How the checkpoint and the learner differ in what has this name."""
    if name not in state:
        return f"the checkpoint has no {name}"
    if name not in tensors:
        return f"here is no {name}"
    there, here = state[name], tensors[name]
    if np.shape(there) != tuple(here.shape):
        return f"{name} has the shape {list(np.shape(there))} there and {list(here.shape)} here"
    return f"{name} is {np.asarray(there).tolist()} there and {here.tolist()} here"


def check_finite(tensors: Mapping[str, Tensor]) -> None:
    """Raise Diverged where a tensor holds a number that is not finite, naming the first of them."""
    floats = {k: t for k, t in tensors.items() if t.is_floating_point()}
    if not torch.cat([t.detach().flatten() for t in floats.values()]).isfinite().all():
        refuse([name for name, t in floats.items() if not t.isfinite().all()])


def refuse(bad: Sequence[str]) -> None:
    """Raise Diverged naming the first of what is bad, if anything is."""
    if bad:
        more = f" and {len(bad) - 3} more" if len(bad) > 3 else ""
        raise Diverged(f"not finite: {', '.join(bad[:3])}{more}")


# Whose numbers are whose ---------------------------------------------------------------------------------------------


def leaders(state: State, agents: int) -> list[int]:
    """For each agent of a state the one whose name its actor has: itself, unless equal robots share one."""
    return state["sharing"].tolist() if "sharing" in state else list(range(agents))


def with_actor(state: State, i: int, given: State, j: int) -> dict[str, np.ndarray]:
    """The state with agent i's actor, and what it knows of observations, as agent j's was in another learner."""
    mine, theirs = (leaders(s, _agents(s)) for s in (state, given))
    here, there = mine[i], theirs[j]
    new = {k.replace(f".{there}.", f".{here}.", 1): v for k, v in given.items() if k.startswith(f"actor.{there}.")}
    return {**state, **new}


def with_critics(state: State, given: State) -> dict[str, np.ndarray]:
    """The state with another learner's critics, their value normalisers and what they know of observations."""
    return {**state, **{k: v for k, v in given.items() if k.startswith(("critic.", "value_norm."))}}


def unmoved(state: State) -> dict[str, np.ndarray]:
    """The state with networks to which inputs that never moved say nothing yet; while they rest, these are the same.

    What a stage does not have yet is a constant there, of which the normaliser makes 0, so its weights stay as they
    were drawn. Where it then moves, a deviation of nothing would make it as large as is allowed, and the policy a new
    one. Of how it moves nothing is known, so the first batch says that. Behind a LayerNorm the weights matter even at
    rest, and stay; the deviation is 1 in any case.
    """
    state = upgraded(state)
    new = dict(state)
    for name in (name for name in state if name.endswith(".trunk.observation_var")):
        trunk, rests = name.removesuffix("observation_var"), state[name] < CONSTANT
        new[name] = np.where(rests, np.ones_like(state[name]), state[name])
        if f"{trunk}norm.0.weight" not in state:
            weights = state[f"{trunk}hidden.0.weight"]
            new[f"{trunk}hidden.0.weight"] = np.where(rests, np.zeros_like(weights), weights)
            observed = f"{trunk.removesuffix('trunk.')}observed"
            new[observed] = np.where(rests, np.zeros_like(state[observed]), state[observed])
    return new


def upgraded(state: State) -> dict[str, np.ndarray]:
    """The state as it is written now. Until 0.2 it had one count of decisions for all that an actor or critic sees."""
    new = dict(state)
    if (counts := new.pop("observation_counts", None)) is not None:
        end = ".trunk.observation_mean"
        networks = sorted((k.removesuffix(end) for k in state if k.endswith(end)), key=_place)
        new |= {f"{k}.observed": np.full_like(state[k + end], n) for k, n in zip(networks, counts, strict=True)}
    return new


def observed(state: State) -> dict[str, np.ndarray]:
    """What of the state says of how many decisions each number that is seen is known."""
    return {k: v for k, v in state.items() if k.endswith(".observed")}


def _agents(state: State) -> int:
    """How many agents a state without shared actors has."""
    return len({k.split(".")[1] for k in state if k.startswith("actor.")})


def _place(network: str) -> tuple[str, int]:
    """Networks in their order: actors, then critics, by their numbers."""
    kind, _, number = network.partition(".")
    return kind, int(number or 0)
