"""TorchScript files as policies, run by torch on the CPU."""

import io
import warnings
from typing import Any

import numpy as np
import torch

from league.snapshots.programs.model import ACTIONS, NEXT, NOISE, AgentSizes, Arrays, Model, ProgramError, roles
from league.snapshots.programs.torchscript_state import InnerState


def load(data: bytes, name: str, agent: AgentSizes) -> Model:
    """Return the model in a TorchScript file. Raises ProgramError for a file that is none.

    Its `forward` takes one tensor or several by the names of `roles`. With memory it returns (actions, next memory,
    ...) in the order of its arguments, and its attribute `x_size` has the size of a memory `x`. A module that keeps
    its state inside is called for one world at a time, each with a state of its own.
    """
    try:
        module = _module(data)
        module.eval()
        arguments = [each.name for each in module.forward.schema.arguments[1:]]
    except Exception as error:  # torch raises RuntimeError, ValueError, AttributeError, ...
        reason = " ".join(str(error).split())[:200]
        raise ProgramError(
            f"{name} is no TorchScript file ({reason}): save a module by torch.jit.script(module).save(file)"
        ) from None
    sees, noise, memory = roles(arguments, f"{name}: forward")
    sizes = {each: _memory_size(module, name, each) for each in memory}
    seen, still = agent.trial(1)
    trial = {sees: seen, NOISE: still, **{each: np.zeros((1, size), np.float32) for each, size in sizes.items()}}
    with torch.inference_mode():
        state = InnerState(module, tuple(torch.from_numpy(trial[each]) for each in arguments), name)

    def run(given: Arrays) -> Arrays:
        """Run the module; single results count as actions."""
        with torch.inference_mode():
            state.set(given)
            found = module(*(torch.from_numpy(np.array(given[each])) for each in arguments))
            after = {NEXT + each: x[None] for each, x in state.read().items()}
        found = list(found) if isinstance(found, (tuple, list)) else [found]
        names = [ACTIONS, *(NEXT + each for each in memory)]
        return dict(zip(names, (x.numpy() for x in found), strict=False)) | after

    inside = state.initial
    sizes |= {each: len(x) for each, x in inside.items()}
    return Model(run, sees, ACTIONS, noise, sizes, 1 if inside else None, inside)


def parameters(data: bytes, name: str) -> int:
    """Return the number of a module's parameters and buffers, and of the constants that freezing made of them."""
    module = _module(data)
    graph: Any = module.inlined_graph  # its nodes live as long as it does
    held = [node.t("value") for node in graph.findAllNodes("prim::Constant") if _is_tensor(node)]
    return sum(each.numel() for each in (*module.parameters(), *module.buffers(), *held))


def _module(data: bytes) -> Any:  # torch.jit.ScriptModule, whose types are unfinished
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch advises its successor, which others do not read
        return torch.jit.load(io.BytesIO(data), map_location="cpu")


def _is_tensor(node: Any) -> bool:
    return node.hasAttribute("value") and node.kindOf("value") == "t"


def _memory_size(module: torch.jit.ScriptModule, name: str, memory: str) -> int:
    size = getattr(module, f"{memory}_size", None)
    if not isinstance(size, int) or size < 1:
        raise ProgramError(
            f"{name}: forward takes memory {memory}, and has no attribute {memory}_size: int that tells its size"
        )
    return size
