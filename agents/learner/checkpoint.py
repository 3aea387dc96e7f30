"""The state of a learner as named arrays: writing, reading, and which states are refused."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from agents.errors import Diverged
from agents.policy import entity_places
from agents.policy.constant_inputs import has_input_norm, is_constant, silence_constant_inputs

State = Mapping[str, np.ndarray]
NETWORKS = ("actor.", "critic.")  # prefixes of networks' arrays: an additional one means another network


def write(tensors: Mapping[str, Tensor], rng: torch.Generator) -> dict[str, np.ndarray]:
    """Return copies of all tensors and the state of the random number generator."""
    arrays = {name: tensor.detach().cpu().numpy().copy() for name, tensor in tensors.items()}
    return {**arrays, "rng": rng.get_state().numpy().copy()}


def read(tensors: Mapping[str, Tensor], fixed: Collection[str], rng: torch.Generator, state: State) -> None:
    """Write a state into the tensors and the random number generator.

    `fixed` names arrays that must be equal, such as activation functions. Raises ValueError naming arrays that are
    missing, of another shape, unknown or not finite; then nothing has changed.
    """
    wrong = [k for k, t in tensors.items() if k not in state or np.shape(state[k]) != tuple(t.shape)]
    wrong += [k for k in fixed if k not in wrong and not np.array_equal(state[k], tensors[k].cpu().numpy())]
    wrong += [k for k in state if k not in tensors and k.startswith(NETWORKS)]
    wrong += ["rng"] if "rng" not in state else []
    if wrong:
        names = f"{', '.join(wrong[:3])} ({len(wrong)} in all)"
        raise ValueError(f"the checkpoint does not fit this learner: {names}; {_difference(wrong[0], tensors, state)}")
    bad = [k for k in tensors if not np.isfinite(state[k]).all()]
    if bad:
        raise ValueError(f"the checkpoint is not finite in {', '.join(bad[:3])} ({len(bad)} in all)")
    with torch.no_grad():
        for name, tensor in tensors.items():
            tensor.copy_(torch.from_numpy(np.array(state[name])))
    rng.set_state(torch.from_numpy(np.array(state["rng"])))


def _difference(name: str, tensors: Mapping[str, Tensor], state: State) -> str:
    """Describe how the checkpoint and the learner differ in the array of this name."""
    if name not in state:
        return f"the checkpoint has no {name}"
    if name not in tensors:
        return f"here is no {name}"
    there, here = state[name], tensors[name]
    if np.shape(there) != tuple(here.shape):
        return f"{name} has the shape {list(np.shape(there))} there and {list(here.shape)} here"
    return f"{name} is {np.asarray(there).tolist()} there and {here.tolist()} here"


def check_finite(tensors: Mapping[str, Tensor]) -> None:
    """Raise Diverged if a tensor holds a number that is not finite, naming the first ones."""
    floats = {k: t for k, t in tensors.items() if t.is_floating_point()}
    if not torch.cat([t.detach().flatten() for t in floats.values()]).isfinite().all():
        raise_diverged([name for name, t in floats.items() if not t.isfinite().all()])


def raise_diverged(bad: Sequence[str]) -> None:
    """Raise Diverged naming the first entries of `bad`, if there is any."""
    if bad:
        more = f" and {len(bad) - 3} more" if len(bad) > 3 else ""
        raise Diverged(f"not finite: {', '.join(bad[:3])}{more}")


# Parts of a state ----------------------------------------------------------------------------------------------------


def actor_owners(state: State, agents: int) -> list[int]:
    """Return for each agent the agent under whose name its actor is stored: itself, unless equal robots share one."""
    return state["sharing"].tolist() if "sharing" in state else list(range(agents))


def actors(state: State, agents: int) -> list[dict[str, np.ndarray]]:
    """Return each agent's policy as `HappoLearner.export` gives it. Raises ValueError for a state without policies."""
    found = []
    for owner in actor_owners(state, agents):
        named = {k.removeprefix(f"actor.{owner}."): v for k, v in state.items() if k.startswith(f"actor.{owner}.")}
        found.append({name: array for name, array in named.items() if name != "observed"})
    if len(found) != agents or not all(found):
        raise ValueError(f"the state has no policies of {agents} agents")
    return found


def with_actor(state: State, i: int, given: State, j: int) -> dict[str, np.ndarray]:
    """Return the state with agent i's actor and its observation statistics taken from agent j of another learner.

    Sets of entities may have another number of entities there. Raises ValueError if they differ in more.
    """
    mine, theirs = (actor_owners(s, _agents(s)) for s in (state, given))
    here, there = mine[i], theirs[j]
    network = f"actor.{here}."
    new = {k.replace(f".{there}.", f".{here}.", 1): v for k, v in given.items() if k.startswith(f"actor.{there}.")}
    size, before = (np.size(arrays[f"{network}trunk.observation_mean"]) for arrays in (state, new))
    to = entity_places.places_of(state, network)
    return {**state, **(entity_places.refitted(new, network, to) if to and size != before else new)}


def with_inputs(state: State, i: int, places: np.ndarray) -> dict[str, np.ndarray]:
    """Return the state with agent i's actor made for another observation, with its statistics.

    `places` (n,) int has the place of each new input in the former observation; -1 for an input that the actor has
    never seen. Such an input has no effect at first, and the first batch sets its statistics. Raises ValueError for an
    actor whose first layer does not see the observation alone and unchanged, input by input.
    """
    network = f"actor.{actor_owners(state, _agents(state))[i]}."
    if has_input_norm(state, network):
        raise ValueError("its network normalises all its inputs together (learner.architecture.layer_norm)")
    if entity_places.places_of(state, network):
        raise ValueError("its network encodes sets of entities (learner.architecture.entities)")
    known, weights = places >= 0, f"{network}trunk.hidden.0.weight"
    new = {**state, weights: np.where(known, state[weights][:, places], 0).astype(state[weights].dtype)}
    unseen = {"trunk.observation_mean": 0.0, "trunk.observation_var": 1.0, "observed": 0}
    for name, value in unseen.items():
        before = state[f"{network}{name}"]
        new[f"{network}{name}"] = np.where(known, before[places], value).astype(before.dtype)
    return new


def with_critics(state: State, given: State) -> dict[str, np.ndarray]:
    """Return the state with another learner's critics, their value normalisers and observation statistics."""
    return {**state, **{k: v for k, v in given.items() if k.startswith(("critic.", "value_norm."))}}


def with_constant_inputs_silenced(state: State) -> dict[str, np.ndarray]:
    """Return the state with networks in which constant inputs have no effect (`agents.policy.constant_inputs`).

    The first batch then sets the statistics of such an input, of whose variation nothing is known.
    """
    state = upgrade_state(state)
    new = dict(state)
    for name in (k for k in state if k.endswith(".trunk.observation_var") and k.startswith(NETWORKS)):
        network = name.removesuffix("trunk.observation_var")
        constant, new = is_constant(state, network), silence_constant_inputs(new, network)
        if not has_input_norm(state, network):
            new[f"{network}observed"] = np.where(
                constant, np.zeros_like(state[f"{network}observed"]), state[f"{network}observed"]
            )
    return new


def with_magnets(state: State) -> dict[str, np.ndarray]:
    """Return the state with each policy as its own magnet, unless it has magnets."""
    if any(name.startswith("magnet.") for name in state):
        return dict(state)
    actors = {k: v for k, v in state.items() if k.startswith("actor.") and not k.endswith(".observed")}
    ages = {f"magnet.actor.{name.split('.')[1]}.age": np.zeros((), np.int64) for name in actors}
    return {**state, **{f"magnet.{name}": value for name, value in actors.items()}, **ages}


def without_magnets(state: State) -> dict[str, np.ndarray]:
    """Return the state without magnets."""
    return {name: value for name, value in state.items() if not name.startswith("magnet.")}


def upgrade_state(state: State) -> dict[str, np.ndarray]:
    """Return the state in its current format.

    Until 0.2 each actor and critic had one count of decisions for all its inputs.
    """
    new = dict(state)
    if (counts := new.pop("observation_counts", None)) is not None:
        end = ".trunk.observation_mean"
        networks = sorted((k.removesuffix(end) for k in state if k.endswith(end)), key=_network_order)
        new |= {f"{k}.observed": np.full_like(state[k + end], n) for k, n in zip(networks, counts, strict=True)}
    return new


def observed(state: State) -> dict[str, np.ndarray]:
    """Return the arrays of the state that count, for each input, the decisions in its statistics."""
    return {k: v for k, v in state.items() if k.endswith(".observed")}


def _agents(state: State) -> int:
    """Return the number of agents of a state without shared actors."""
    return len({k.split(".")[1] for k in state if k.startswith("actor.")})


def _network_order(network: str) -> tuple[str, int]:
    """Return a sorting key of networks: actors, then critics, by their numbers."""
    kind, _, number = network.partition(".")
    return kind, int(number or 0)
