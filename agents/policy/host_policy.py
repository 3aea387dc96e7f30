"""Policies that act on the host: programs such as an ONNX file or a Python function, called once for each decision.

In a `PolicyStack` such a policy is a number, as a script is, so that one compiled rollout serves all of them. The
number leads to the policy of this process. What a recurrent or stateful policy remembers stays on the host, apart for
each agent, group and number of worlds (a match or a recording has others than training); it restarts where an episode
begins.
"""

from collections.abc import Callable
from functools import partial
from itertools import count
from typing import NamedTuple, Protocol, runtime_checkable
from weakref import WeakValueDictionary

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.experimental import io_callback


class Actor(Protocol):
    """A policy in one seat: it returns actions (n, act) for observations (n, obs) of n worlds, all float32.

    `noise` (n, act) are standard normal numbers for a policy that explores. `first` (n,) bool marks the worlds in which
    an episode begins, and all at the first call: what is remembered of them is void. Successive calls are successive
    decisions of the same worlds. It may raise anything.
    """

    def __call__(self, observations: np.ndarray, noise: np.ndarray, first: np.ndarray) -> np.ndarray:
        """Return the actions."""
        ...


@runtime_checkable
class Remembering(Protocol):
    """An actor that can go on in the episodes of another one."""

    def take_over(self, other: Actor) -> None:
        """Remember what the other actor remembers, as far as the two are alike."""
        ...


class HostPolicy:
    """The policy of one agent as a program of this process; `number` names it in policy stacks while it exists."""

    def __init__(self, make: Callable[[], Actor], action_size: int, report: Callable[[str], None]):
        """Prepare a policy. `make` makes an actor for a seat; `report` is told of the first fault, in a few words."""
        self._make, self.action_size, self._report = make, action_size, report
        self._seats: dict[tuple[str, int, int], Actor] = {}
        self._faulty = False
        self.number = next(_numbers)
        _policies[self.number] = self

    def act(self, agent: str, group: int, observations: np.ndarray, noise: np.ndarray, first: np.ndarray) -> np.ndarray:
        """Return actions (n, act) of an agent in a group of worlds; NaN, which the agent forfeits by, after a fault."""
        shape = (len(observations), self.action_size)
        try:
            actor, new = self._seat(agent, group, len(observations))
            actions = np.asarray(actor(observations, noise, np.ones_like(first) if new else first))
            if actions.shape != shape:
                return self._fault(f"returned actions of shape {actions.shape} instead of {shape}", shape)
            if not np.isfinite(actions := actions.astype(np.float32)).all():
                self._fault("returned actions that are not finite", shape)
            return actions
        except Exception as error:  # a stranger's code: it may raise anything, and the league goes on
            return self._fault(f"raised {type(error).__name__}: {' '.join(str(error).split())[:300]}", shape)

    def exchange(self, make: Callable[[], Actor]) -> None:
        """Act by other actors from now on; in each seat a new one takes over what the old one remembers."""
        self._make = make
        for seat, old in self._seats.items():
            self._seats[seat] = new = make()
            if isinstance(new, Remembering):
                new.take_over(old)

    def _seat(self, agent: str, group: int, worlds: int) -> tuple[Actor, bool]:
        """Return the actor of a seat, and whether it is new."""
        seat = agent, group, worlds
        new = seat not in self._seats
        if new:
            self._seats[seat] = self._make()
        return self._seats[seat], new

    def _fault(self, what: str, shape: tuple[int, int]) -> np.ndarray:
        if not self._faulty:
            self._faulty = True
            self._report(what)
        return np.full(shape, np.nan, np.float32)


_numbers = count(1)
_policies: WeakValueDictionary[int, HostPolicy] = WeakValueDictionary()


class HostSeats(NamedTuple):
    """The groups of worlds in which host policies act for an agent."""

    number: Array  # (K,) int32: the number of a group's host policy; 0: another policy acts there
    blank: Array  # (act,) zeros, for the size of an action


def host_seats(numbers: list[int], action_size: int) -> HostSeats:
    """Return the seats of host policies by the groups' numbers, 0 for other policies."""
    return HostSeats(jnp.asarray(numbers, jnp.int32), jnp.zeros(action_size))


def act_on_host(seats: HostSeats, agent: str, seen: Array, group_keys: Array, first: Array) -> Array:
    """Return actions (K, n, act) of the host policies for observations (K, n, obs), one key per world; else zeros.

    The noise is that which a learned policy would draw from the same keys. `first` (K, n) bool marks new episodes.
    """
    size = seats.blank.shape[-1]
    noise = jax.vmap(jax.vmap(lambda key: jax.random.normal(key, (size,))))(group_keys)
    shape = jax.ShapeDtypeStruct(noise.shape, noise.dtype)
    return io_callback(partial(_answer, agent), shape, seats.number, seen, noise, first)


def _answer(agent: str, numbers: Array, seen: Array, noise: Array, first: Array) -> np.ndarray:
    inputs = np.asarray(seen), np.asarray(noise), np.asarray(first)
    actions = np.zeros(inputs[1].shape, np.float32)
    for group, number in enumerate(np.asarray(numbers).tolist()):
        if number:
            actions[group] = _policies[number].act(agent, group, *(each[group] for each in inputs))
    return actions
