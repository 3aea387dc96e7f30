"""State that a TorchScript module keeps inside: buffers and attributes that change as it is called.

Exporters of libraries for legged robots write recurrent policies so, for one robot, with a method that resets it. Here
each world needs a state of its own. So it is read and set around every call, like memory that is an argument.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch

from league.snapshots.programs.model import ProgramError

RESETS = ("reset", "reset_memory")  # names of methods that make a state new
CALLS = 3  # with which a state is looked for
Place = tuple[str, ...]  # names of modules, and of the attribute in the last of them
Call = tuple[torch.Tensor, ...]  # arguments for one world


class InnerState:
    """The parts of a module's state, by names that no argument of Python has; empty for a module without state.

    `initial` has their values where an episode begins, as flat arrays of float32.
    """

    def __init__(self, module: Any, trial: Call, name: str):
        """Look for the state by a few calls. Raises ProgramError if it cannot be read and set."""
        self._module = module
        places = list(_places(module))
        saved = {place: _copy(_value(module, place)) for place in places}
        changed: set[Place] = set()
        try:
            for _ in range(CALLS):
                module(*trial)
                changed |= {place for place in places if not _same(saved[place], _value(module, place))}
        except Exception:  # it takes no such observations, which a trial tells in words
            pass
        after = {place: _value(module, place) for place in changed}
        for place in changed:
            setattr(_owner(module, place), place[-1], saved[place])
        _reset(module, name)
        self._kinds = {}
        self.initial: dict[str, np.ndarray] = {}
        for place in sorted(changed):
            first, attribute = _value(module, place), ".".join(place)
            if not _is_kept(first, after[place]):
                raise ProgramError(
                    f"{name} keeps its state inside, in {attribute}, which is no tensor of one size: make it an"
                    f" argument x of forward and a result next_x, or a buffer"
                )
            self._kinds[f"inside {attribute}"] = place, first.shape, first.dtype
            self.initial[f"inside {attribute}"] = _flat(first)

    def set(self, values: Mapping[str, np.ndarray]) -> None:
        """Give the module the state of a world; other inputs among the values are left alone."""
        for name, (place, shape, dtype) in self._kinds.items():
            # A new tensor, because results of earlier calls may share memory with the present one.
            tensor = torch.from_numpy(np.array(values[name])).reshape(shape).to(dtype)
            setattr(_owner(self._module, place), place[-1], tensor)

    def read(self) -> dict[str, np.ndarray]:
        """Return the module's present state, as `set` takes it."""
        return {name: _flat(_value(self._module, place)) for name, (place, _, _) in self._kinds.items()}


def _places(module: Any) -> Iterator[Place]:
    """Yield the places of buffers, and of attributes that `forward` reads or sets, once each; not those of weights."""
    found = {tuple(name.split(".")) for name, _ in module.named_buffers()}
    graph: Any = module.inlined_graph  # its nodes live as long as it does
    for kind in ("prim::GetAttr", "prim::SetAttr"):
        for node in graph.findAllNodes(kind):
            place: Place = ()
            while node.kind() in ("prim::GetAttr", "prim::SetAttr"):
                place = (node.s("name"), *place)
                node = node.inputsAt(0).node()
            if node.kind() == "prim::Param":
                found.add(place)
    for place in sorted(found):
        if not isinstance(_value(module, place), (torch.nn.Module, torch.nn.Parameter)):
            yield place


def _owner(module: Any, place: Place) -> Any:
    for name in place[:-1]:
        module = getattr(module, name)
    return module


def _value(module: Any, place: Place) -> Any:
    return getattr(_owner(module, place), place[-1])


def _reset(module: Any, name: str) -> None:
    """Make the state new by the module's own method, if it has one that takes no argument. Raises ProgramError."""
    for each in RESETS:
        method = getattr(module, each, None)
        if method is None or not all(argument.has_default_value() for argument in method.schema.arguments[1:]):
            continue
        try:
            method()
        except Exception as error:  # a stranger's code
            reason = str(error).strip().splitlines()[-1][:200]  # below a long traceback
            raise ProgramError(f"{name}: its method {each}, which begins an episode, raises {reason}") from None


def _copy(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return type(value)(map(_copy, value))
    return value.clone() if isinstance(value, torch.Tensor) else value


def _same(one: Any, other: Any) -> bool:
    """Return whether two values of an attribute are equal; objects of classes, which have no value, count as equal."""
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return one.shape == other.shape and torch.equal(one, other)
    if isinstance(one, (list, tuple)) and isinstance(other, (list, tuple)):
        return len(one) == len(other) and all(map(_same, one, other))
    plain = (torch.Tensor, list, tuple, bool, int, float, str, type(None))
    if not isinstance(one, plain) or not isinstance(other, plain):
        return True
    return type(one) is type(other) and bool(one == other)


def _is_kept(first: Any, after: Any) -> bool:
    """Return whether a part of a state is a tensor of the same size and type before and after a call."""
    if not isinstance(first, torch.Tensor) or not isinstance(after, torch.Tensor):
        return False
    return first.shape == after.shape and first.dtype == after.dtype and not first.is_complex()


def _flat(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().to(torch.float32).flatten().numpy().copy()
