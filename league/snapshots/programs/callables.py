"""Python functions and objects as policies: NumPy, JAX or torch, with or without a memory of their own.

A callable takes observations (n, obs) float32 and returns actions (n, act); or, one world at a time, (obs,) and (act,).
One with a method `reset` has a memory: every seat plays with a copy of its own, and `reset(first)` comes before the
decisions in which episodes begin, with `first` (n,) bool; one world at a time, every world has a copy, and `reset()`
takes nothing. A class is called for each copy instead. A `torch.nn.Module` gets tensors.
"""

import copy
import hashlib
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agents.policy.host_policy import Actor
from arenas import python_file
from arenas.errors import describe_error
from league.snapshots.programs.model import AgentSizes, ProgramError


class BatchedCallable:
    """A callable in one seat that takes the observations of all worlds at once."""

    def __init__(self, policy: Callable[..., Any]):
        self._policy: Any = own_copy(policy)

    def __call__(self, observations: np.ndarray, noise: np.ndarray, first: np.ndarray) -> np.ndarray:
        """Return actions (n, act). Raises whatever the callable raises."""
        if first.any() and hasattr(self._policy, "reset"):
            self._policy.reset(first.copy())
        return _called(self._policy, observations)


class SingleCallable:
    """A callable in one seat that takes one world's observation at a time; with memory, each world has a copy."""

    def __init__(self, policy: Callable[..., Any]):
        self._policy, self._copies = policy, list[Any]()

    def __call__(self, observations: np.ndarray, noise: np.ndarray, first: np.ndarray) -> np.ndarray:
        """Return actions (n, act). Raises whatever the callable raises."""
        while len(self._copies) < len(observations):
            self._copies.append(own_copy(self._policy))
        for policy, begins in zip(self._copies, first.tolist(), strict=True):
            if begins and hasattr(policy, "reset"):
                policy.reset()
        return np.stack([_called(policy, x) for policy, x in zip(self._copies, observations, strict=True)])


def own_copy(policy: Callable[..., Any]) -> Callable[..., Any]:
    """Return a callable for one seat: a new object of a class, a copy if there is memory, else the callable itself."""
    if isinstance(policy, type):
        return policy()
    return copy.deepcopy(policy) if hasattr(policy, "reset") else policy


def maker(policy: Callable[..., Any], agent: AgentSizes, name: str) -> tuple[Callable[[], Actor], str]:
    """Return a function that makes actors of a callable, and how it is called: batched, or single.

    It is tried on a few observations. Raises ProgramError if it takes neither a batch nor one observation.
    """
    faults = []
    shape = (3, agent.action)
    for how, kind in (("batched", BatchedCallable), ("single", SingleCallable)):
        make = partial(kind, policy)
        try:
            trial = make()(*agent.trial(3), np.ones(3, bool))
        except Exception as error:  # a stranger's code
            faults.append(f"{type(error).__name__}: {' '.join(str(error).split())[:150]}")
            continue
        if trial.shape == shape:
            return make, how
        faults.append(f"shape {trial.shape}")
    raise ProgramError(
        f"{name} does not map observations (n, {agent.observation}) to actions (n, {agent.action}), nor one observation"
        f" to one action, for a {agent.kind}: a batch of 3 gave {faults[0]}, single ones {faults[1]}"
    )


def load(where: str, digest: str | None = None) -> tuple[Callable[..., Any], str]:
    """Return the callable that `file.py:name` names, and the file's SHA-256.

    Runs the file. Raises ProgramError if it is missing, has no such callable, or is not the file of this digest.
    """
    file, _, name = where.rpartition(":")
    path = Path(file)
    if not path.is_file():
        raise ProgramError(
            f"{where}: there is no file {file or where}; a policy in Python is named as file.py:function"
        )
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest not in (None, found):
        raise ProgramError(
            f"{file} has changed since {name} was imported from it: import it under another name, or restore the file"
        )
    try:
        policy = getattr(python_file(path), name, None)
    except (Exception, SystemExit) as error:
        raise ProgramError(f"{where}: {describe_error(error, [path.resolve()])}") from error
    if not callable(policy):
        raise ProgramError(f"{file} has no function or class {name!r}")
    return policy, found


def _called(policy: Callable[..., Any], observations: np.ndarray) -> np.ndarray:
    """Call a policy, and return its answer as an array."""
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(policy, torch.nn.Module):
        with torch.no_grad():
            return policy(torch.from_numpy(observations.copy())).cpu().numpy()
    found = policy(observations.copy())
    return found.detach().cpu().numpy() if hasattr(found, "detach") else np.asarray(found)
