"""Policies that encode sets of entities, for observations in which the sets have other numbers of entities.

The weights of an encoder are those of one entity, so they fit any number. What has the size of an observation, which is
the places of entities and the statistics of inputs, is made for the other observation. All entities of a set have the
statistics of the set (`EntityEncoder.pooled`).
"""

from collections.abc import Mapping, Sequence

import numpy as np

Index = Sequence[Sequence[int]]
"""A set: (entities, numbers of each), places in the observation."""
OF_INPUTS = ("trunk.observation_mean", "trunk.observation_var", "observed")
"""Arrays with a number for each input; a snapshot has no `observed`."""

Arrays = Mapping[str, np.ndarray]


def own_numbers(size: int, sets: Sequence[Index]) -> list[int]:
    """Return the places in an observation of `size` numbers that belong to no entity."""
    taken = {place for index in sets for entity in index for place in entity}
    return [place for place in range(size) if place not in taken]


def places(sets: Sequence[Index], size: int) -> dict[str, np.ndarray]:
    """Return the places of sets and of own numbers in observations of that size, by their names in a policy."""
    found = {f"trunk.entities.{i}.index": np.array(each, np.int32) for i, each in enumerate(sets)}
    return {**found, "trunk.own": np.array(own_numbers(size, sets), np.int32)} if sets else {}


def places_of(arrays: Arrays, network: str) -> dict[str, np.ndarray]:
    """Return the places of the network whose arrays begin with `network`; empty if it encodes no sets."""
    named = {name.removeprefix(network): array for name, array in arrays.items() if name.startswith(network)}
    return {name: np.asarray(array) for name, array in named.items() if name.endswith((".index", "trunk.own"))}


def refitted(arrays: Arrays, network: str, to: Arrays) -> dict[str, np.ndarray]:
    """Return the arrays with that network's for observations whose places are `to`, see `places`.

    Raises ValueError, in words, if the sets differ in more than their numbers of entities.
    """
    at, new = places_of(arrays, network), dict(arrays)
    if {name: array.tolist() for name, array in at.items()} == {name: array.tolist() for name, array in to.items()}:
        return new
    if wrong := _difference(at, to):
        raise ValueError(wrong)
    size = sum(array.size for array in to.values())
    for name in OF_INPUTS:
        if (before := arrays.get(f"{network}{name}")) is not None:
            after = np.zeros(size, np.asarray(before).dtype)
            after[to["trunk.own"]] = before[at["trunk.own"]]
            for index in to.keys() - {"trunk.own"}:
                after[to[index]] = before[at[index][0]]
            new[f"{network}{name}"] = after
    return new | {f"{network}{name}": array for name, array in to.items()}


def _difference(at: Arrays, to: Arrays) -> str:
    """Describe how places differ otherwise than in numbers of entities; empty if they do not."""
    if not at or not to:
        return f"it encodes {'sets' if at else 'no sets'} of entities there, and {'sets' if to else 'none'} here"
    if at.keys() != to.keys():
        return f"it encodes {len(at) - 1} sets of entities there and {len(to) - 1} here: an empty set is none"
    if (own := at["trunk.own"].size) != (here := to["trunk.own"].size):
        return f"{own} numbers of its observation belong to no entity there, and {here} here"
    for name in sorted(at.keys() - {"trunk.own"}):
        if at[name].shape[1] != to[name].shape[1]:
            number = name.split(".")[2]
            return f"an entity of set {number} has {at[name].shape[1]} numbers there and {to[name].shape[1]} here"
    return ""
