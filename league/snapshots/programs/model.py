"""The common part of all kinds of program: sizes, calls in batches or in a loop, memory that restarts with an episode.

A program has inputs by name. One is the observation; one named `noise` gets standard normal numbers; each other one is
memory `x`, which an output `next_x` renews. Without such names its one input is the observation, its first output the
action.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from agents.policy.host_policy import Actor
from storage.errors import StorageError

NOISE, OBSERVATIONS, ACTIONS, NEXT = "noise", "observations", "actions", "next_"
Arrays = Mapping[str, np.ndarray]


class ProgramError(StorageError):
    """A program cannot be a policy of that team; the message names the file and what is wrong with it."""


class AgentSizes(NamedTuple):
    """The agent that a program has to serve."""

    kind: str
    observation: int  # numbers in its observation
    action: int  # numbers in its action

    def trial(self, worlds: int) -> tuple[np.ndarray, np.ndarray]:
        """Return standard normal observations (worlds, obs), the same ones each time, and zeros as noise (worlds, act).

        Zeros are no observations of a game: a policy that divides by a distance would fail there.
        """
        seen = np.random.default_rng(0).standard_normal((worlds, self.observation), np.float32)
        return seen, np.zeros((worlds, self.action), np.float32)


@dataclass(frozen=True)
class Model:
    """A loaded program. `run` maps inputs by name, each (n, size), to outputs by name, each (n, size)."""

    run: Callable[[Arrays], Arrays]
    sees: str  # the input with the observation
    acts: str  # the output with the action
    noise: bool = False  # it has an input `noise`
    memory: Mapping[str, int] = field(default_factory=dict)  # input -> size; the output `next_<input>` renews it
    rows: int | None = None  # number of worlds that it takes at once; None: any number
    initial: Arrays = field(default_factory=dict)  # memory (size,) where an episode begins; zeros without

    def actor(self, agent: AgentSizes) -> "ModelActor":
        """Return an actor of its own memory."""
        return ModelActor(self, agent)


class ModelActor:
    """A model in one seat, see `agents.policy.host_policy.Actor`."""

    def __init__(self, model: Model, agent: AgentSizes):
        self._model, self._agent = model, agent
        self._memory: dict[str, np.ndarray] = {}

    def __call__(self, observations: np.ndarray, noise: np.ndarray, first: np.ndarray) -> np.ndarray:
        """Return actions (n, act). Raises whatever the program raises."""
        model, number = self._model, len(observations)
        inputs = {model.sees: observations, **({NOISE: noise} if model.noise else {})}
        for name, size in model.memory.items():
            initial = np.broadcast_to(model.initial.get(name, np.float32(0)), (number, size))
            inputs[name] = np.where(first[:, None], initial, self._memory.get(name, initial))
        outputs = run_in_pieces(model, inputs)
        for name in model.memory:
            self._memory[name] = np.asarray(outputs[NEXT + name], np.float32)
        return outputs[model.acts]

    def take_over(self, other: Actor) -> None:
        """Remember what another model remembers of the same worlds, as far as it has memories of the same sizes."""
        if isinstance(other, ModelActor):
            sizes = self._model.memory
            self._memory = {name: x for name, x in other._memory.items() if sizes.get(name) == x.shape[1]}


def run_in_pieces(model: Model, inputs: Arrays) -> Arrays:
    """Run a model for any number of worlds: at once, or as many at a time as it takes, the last time with zeros."""
    if model.rows is None:
        return model.run(inputs)
    number, pieces = len(inputs[model.sees]), []
    for at in range(0, number, model.rows):
        piece = {name: x[at : at + model.rows] for name, x in inputs.items()}
        short = model.rows - len(piece[model.sees])
        pieces.append(model.run({name: np.pad(x, ((0, short), (0, 0))) for name, x in piece.items()}))
    return {name: np.concatenate([piece[name] for piece in pieces])[:number] for name in pieces[0]}


def roles(names: Sequence[str], what: str) -> tuple[str, bool, list[str]]:
    """Return the observation's name, whether there is noise, and the memories, among a program's inputs.

    Raises ProgramError, which begins with `what`.
    """
    rest = [name for name in names if name != NOISE]
    if OBSERVATIONS in rest:
        sees = OBSERVATIONS
    elif len(rest) == 1:
        sees = rest[0]
    else:
        raise ProgramError(
            f"{what} has the inputs {', '.join(names) or 'none'}: call that of the observation {OBSERVATIONS}"
            f" (beside it, {NOISE} gets normal numbers, and every x is memory that an output {NEXT}x renews)"
        )
    return sees, NOISE in names, [name for name in rest if name != sees]
