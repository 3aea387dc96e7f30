"""Learners of other people's classes: found, made, and called with an eye on what may go wrong in them.

Whatever such a class raises, and whatever it gives that cannot be used, is one line that names its file and verb. It
counts as a setback of the player, as if its learning had diverged, and the others learn on.
"""

import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch

from agents.batch import Batch, clean
from agents.devices.distributed import SINGLE_PROCESS
from agents.learner.interface import Learner
from agents.policy.host_policy import Actor, HostPolicy
from agents.settings import HAPPO
from arenas import python_file
from arenas.arena_settings import Table
from arenas.errors import ArenaError, describe_error
from arenas.state import TeamSpec
from league.snapshots.exports.networks import agents_of
from league.snapshots.programs import stored
from league.snapshots.programs.model import ProgramError
from league.system.memory import is_short
from league.training.setback import PlayerDiverged
from storage.blobs import arrays
from storage.errors import StorageError

VERBS = ("learn", "save", "load", "export")  # without `act`, a learner acts by what it exports
Arrays = Mapping[str, np.ndarray]
PREFIX = "own."  # of its arrays in a checkpoint, where the league keeps others


class LearnerSource(NamedTuple):
    """A class of a user, and what its learner is made of."""

    where: str  # file.py:Class
    settings: Table
    team: TeamSpec
    seed: int
    device: str


class OwnLearner:
    """A player's learner of the class that `source` names."""

    comm = SINGLE_PROCESS
    final_memories: Sequence[torch.Tensor] = ()

    def __init__(self, player: str, source: LearnerSource):
        """Make the learner. Raises PlayerDiverged, one line, if the class cannot be found or made."""
        self.player, self.source = player, source
        device = source.device if source.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
        self.device = torch.device(device)
        with self._blamed(""):
            made = _find(source.where)(source.team.agents, source.settings, source.seed, self.device)
        if missing := [verb for verb in VERBS if not callable(getattr(made, verb, None))]:
            raise self._failed(f" has no method {missing[0]}: a learner has {', '.join(VERBS)}, and act if it likes")
        self._learner: Learner = made
        self._functions: list[Actor | None] = []  # by which agents act now
        self._seats: dict[int, HostPolicy] = {}  # of agents that act by functions
        self._programs: list[HostPolicy] = []  # of agents that act by programs
        self._program = b""  # by which they act now
        self._fault = ""  # of an agent's function, in the newest rollout
        self._learnt = self._reloaded = False  # whether it has, and whether a learnt state was loaded as a test

    # The five methods ------------------------------------------------------------------------------------------------

    def act(self) -> list[Arrays | HostPolicy]:
        """Return how each agent acts in the next rollout: an actor's arrays, or a policy that is called on the host."""
        with self._blamed("act"):
            acts = getattr(self._learner, "act", self._learner.export)
            found: list[Any] = list(acts())
        self._check_count(found, "act")
        if not any(isinstance(each, Mapping) or _is_function(each) for each in found):
            return self._loaded(self._stored(found).to_bytes())
        self._forget()  # programs do not see these decisions
        self._functions = [each if _is_function(each) else None for each in found]
        return [self._seat(i) if _is_function(each) else self._actor(each, i, "act") for i, each in enumerate(found)]

    def learn(self, batch: Batch) -> dict[str, float]:
        """Learn from a batch; return figures, none if the whole batch is void.

        Raises PlayerDiverged for what the class raises, for what its functions raised during the rollout, and for
        figures that are not finite.
        """
        batch = clean(batch)
        all_void = bool(batch.void.all())  # waits for the rollout, and so for all of its faults
        self._raise_fault("its function")
        if all_void:
            return {}
        with self._blamed("learn"):
            figures = {str(name): float(value) for name, value in (self._learner.learn(batch) or {}).items()}
        if bad := [name for name, value in figures.items() if not math.isfinite(value)]:
            raise PlayerDiverged(self.player, f"not finite: {bad[0]} of {self.source.where}.learn")
        self._learnt = True
        return figures or {"learnt": 1.0}

    def save(self) -> dict[str, np.ndarray]:
        """Return the state as arrays; copies, which do not change as it learns on.

        The first state that was learnt is loaded as a test: one of which `load` forgets a part that `try_out` could not
        see, because it had its first value. Raises PlayerDiverged then.
        """
        with self._blamed("save"):
            saved = self._learner.save()
            if nested := [name for name, value in saved.items() if isinstance(value, Mapping)]:
                raise TypeError(f"array {nested[0]!r} is a dict: give one flat dict, with names such as 'adam/0/step'")
            found = {f"{PREFIX}{name}": _array(value) for name, value in saved.items()}
            try:
                arrays.to_bytes(found)
            except StorageError as error:
                raise TypeError(str(error).replace(PREFIX, "")) from None
        if self._learnt and not self._reloaded:
            self._reloaded = True
            self._check_load(found)
        return found

    def load(self, state: Arrays) -> None:
        """Continue from a state. Raises PlayerDiverged also for that of another kind of learner."""
        own = {name.removeprefix(PREFIX): array for name, array in state.items() if name.startswith(PREFIX)}
        if not own and "rng" in state:
            raise self._failed(f": the checkpoint is that of a learner of class {HAPPO}")
        self._forget()
        self._seats.clear()
        with self._blamed("load"):
            self._learner.load(own)

    def export(self) -> list[Arrays] | bytes:
        """Return what a snapshot keeps: each agent's actor as arrays, or the bytes of a program."""
        with self._blamed("export"):
            found: list[Any] = list(self._learner.export())
        self._check_count(found, "export")
        kinds = {isinstance(each, Mapping) for each in found}
        if len(kinds) > 1:
            raise self._failed(".export: gives state dicts for some agents and programs for others")
        if kinds == {True}:
            return [self._actor(each, i, "export") for i, each in enumerate(found)]
        return self._stored(found).to_bytes()

    def play(self) -> list[Arrays | HostPolicy]:
        """Return how each agent acts where the player does not learn: by its policy, without exploring."""
        found = self.export()
        return self._loaded(found) if isinstance(found, bytes) else [*found]

    def reseed(self, seed: int) -> None:
        """Give the learner other random numbers, if its class has a method `reseed`."""
        reseed = getattr(self._learner, "reseed", None)
        if reseed is not None:
            with self._blamed("reseed"):
                reseed(seed)

    def try_out(self) -> None:
        """Act, export, save and load once, without learning. Raises PlayerDiverged for what cannot be used."""
        self.export()
        for i, (policy, agent) in enumerate(zip(self.act(), self.source.team.agents, strict=True)):
            if isinstance(policy, HostPolicy):
                seen, noise = (np.zeros((3, n), np.float32) for n in (agent.observation_size, agent.action_size))
                policy.act(agent.name, 0, seen, noise, np.ones(3, bool))
                self._raise_fault(f"for observations of zeros its function of agent {i}")
        self._check_load(self.save())

    def _check_load(self, saved: Arrays) -> None:
        """Raise PlayerDiverged if another learner that loads a state saves another one."""
        # Of another seed, so that it draws other weights: one that loads nothing would save the same bytes otherwise.
        again = OwnLearner(self.player, self.source._replace(seed=self.source.seed + 1))
        again.load(saved)
        if others := _differing(saved, again.save()):
            what = f"something else ({others[0]}{', ...' if len(others) > 1 else ''})"
            raise self._failed(f".load: afterwards `save` gives {what}: a league could not continue from it")

    def meet(self, opponents: Sequence[str]) -> None:
        """Tell the learner against whom its next rollouts are, if its class has a method `meet`."""
        meet = getattr(self._learner, "meet", None)
        if meet is not None:
            with self._blamed("meet"):
                meet(opponents)

    # What it gives ---------------------------------------------------------------------------------------------------

    def _seat(self, i: int) -> HostPolicy:
        """Return the policy of agent i on the host, which calls the function that `act` gave last."""
        if i not in self._seats:
            size = self.source.team.agents[i].action_size
            self._seats[i] = HostPolicy(lambda: partial(self._call, i), size, self._note)
        return self._seats[i]

    def _call(self, i: int, observations: np.ndarray, noise: np.ndarray, first: np.ndarray) -> np.ndarray:
        function = self._functions[i]
        assert function is not None
        return function(observations.copy(), noise.copy(), first.copy())

    def _note(self, what: str) -> None:
        self._fault = self._fault or what

    def _raise_fault(self, who: str) -> None:
        """Raise PlayerDiverged if a function by which an agent acts has failed."""
        fault, self._fault = self._fault, ""
        if fault:
            raise self._failed(f".act: {who} {fault}")

    def _actor(self, given: Mapping[str, Any], i: int, verb: str) -> Arrays:
        """Return an actor's arrays. Raises PlayerDiverged if they do not fit the agent, or are not finite."""
        with self._blamed(verb):
            found = {str(name): _array(value) for name, value in given.items()}
        if bad := [name for name, value in found.items() if not np.isfinite(value).all()]:
            raise PlayerDiverged(self.player, f"not finite: {bad[0]} of {self.source.where}.{verb}")
        agent = self.source.team.agents[i]
        sizes = f"{agent.kind}:{agent.observation_size}:{agent.action_size}"
        try:
            agents_of({f"0/{name}": value for name, value in found.items()}, sizes)
        except ValueError as error:
            raise self._failed(f".{verb}: the state dict of agent {i} is not that of an Actor: {error}") from None
        return found

    def _stored(self, given: Sequence[Any]) -> stored.Program:
        with self._blamed("export"):
            files = [(str(i), _content(each)) for i, each in enumerate(given)]
        try:
            return stored.of_bytes(files, self.source.team.roster)
        except ProgramError as error:
            raise self._failed(f".export: {error}") from None

    def _loaded(self, program: bytes) -> list[Arrays | HostPolicy]:
        """Return the policies that act by a program; they remember the episodes in which earlier ones acted."""
        if not self._programs:
            self._programs = stored.host_policies(program, self.source.where, self._note)
        elif program != self._program:
            stored.exchange(self._programs, program)
        self._program = program
        return [*self._programs]

    def _forget(self) -> None:
        """Forget the episodes in which programs have acted: they act by new policies next."""
        self._programs = []

    def _check_count(self, found: Sequence[Any], verb: str) -> None:
        team = self.source.team
        if len(found) != len(team.agents):
            raise self._failed(f".{verb}: gives {len(found)} policies for the {len(team.agents)} agents of {team.name}")

    def _failed(self, what: str) -> PlayerDiverged:
        return PlayerDiverged(self.player, f"{self.source.where}{what}", "failed")

    @contextmanager
    def _blamed(self, verb: str) -> Iterator[None]:
        """Turn whatever the class raises into one line that names its file and verb; memory that ran out stays so."""
        try:
            yield
        except (Exception, SystemExit) as error:
            if isinstance(error, PlayerDiverged) or is_short(error):
                raise
            file = Path(self.source.where.rpartition(":")[0]).resolve()
            said = str(error) if isinstance(error, ArenaError) else describe_error(error, [file])
            raise self._failed(f"{verb and '.'}{verb}: {said}") from error


def _find(where: str) -> Callable[..., Any]:
    """Return the class that `file.py:Class` names. Raises ArenaError, one line, or what the file raises."""
    file, _, name = where.rpartition(":")
    if not Path(file).is_file():
        raise ArenaError(f"there is no file {file}")
    module = python_file(Path(file))
    found = getattr(module, name, None)
    if not isinstance(found, type):
        raise ArenaError(f"there is no such class; {_classes(module)}")
    return found


def _classes(module: ModuleType) -> str:
    """Return the words for the classes that a file itself defines."""
    own = [n for n, value in vars(module).items() if isinstance(value, type) and value.__module__ == module.__name__]
    return f"there is: {', '.join(own)}" if own else "the file defines no class"


def _array(value: Any) -> np.ndarray:
    """Return a copy of an array of any library as one of numpy."""
    return np.array(value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else value)


def _differing(state: Arrays, other: Arrays) -> list[str]:
    """Return the names of the arrays that two states do not have alike, bit by bit."""
    names = state.keys() | other.keys()
    return sorted(name.removeprefix(PREFIX) for name in names if _bits(state.get(name)) != _bits(other.get(name)))


def _bits(array: np.ndarray | None) -> tuple[np.dtype, tuple[int, ...], bytes] | None:
    return None if array is None else (array.dtype, array.shape, array.tobytes())


def _is_function(value: Any) -> bool:
    return callable(value) and not isinstance(value, torch.jit.ScriptModule)


def _content(value: Any) -> bytes:
    """Return a program as the content of a file. Raises TypeError for what is none."""
    if isinstance(value, torch.jit.ScriptModule):
        buffer = io.BytesIO()
        torch.jit.save(value, buffer)
        return buffer.getvalue()
    if not isinstance(value, bytes):
        raise TypeError(f"{type(value).__name__} is no policy: give a state dict, bytes or TorchScript")
    return value
