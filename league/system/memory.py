"""Memory that training needs on a device: the estimate before training, and the message for a lack of memory.

Imports nothing heavy, because the preparation of a run uses this module before it builds anything.
"""

import os
import resource
from pathlib import Path
from typing import TYPE_CHECKING, Any

from league.config.experiment import Config
from storage.errors import StorageError

if TYPE_CHECKING:
    from arenas.arena import Arena

SHARE = 0.8  # of the available memory, for training
COPIES = 4  # of each number in a batch: as collected, cleaned, in an actor's input, and in the order of a pass
LAYERS = 3  # copies of the widest layer's numbers in a pass of a whole batch: input, products, output
SIGNS = ("resource_exhausted", "out of memory", "can't allocate memory", "failed to allocate")  # JAX, torch, Warp
SHORT = "out of memory"  # first words of the message about a turn that did not fit
CGROUP = Path("/sys/fs/cgroup/memory.max")


class TooLarge(Exception):  # noqa: N818  (a sentence: "the training is too large")
    """Training ran out of memory; the message is for the user, one line with the number of worlds that would fit."""


def machine() -> int:
    """Return the bytes of memory of this machine, or of its container."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        limit = CGROUP.read_text().strip()
    except OSError:
        return total
    return min(total, int(limit)) if limit.isdigit() else total


def room(device: Any) -> int:
    """Return the bytes that training may still take on a torch device.

    They are SHARE of the free memory of a GPU, else of the memory of the machine. A limit on this process (`ulimit -v`)
    counts too.
    """
    if device.type == "cuda":
        import torch

        return int(SHARE * torch.cuda.mem_get_info(device)[0])
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if limit != resource.RLIM_INFINITY else 0
    left = limit - pages * os.sysconf("SC_PAGE_SIZE") if pages else machine()
    return int(SHARE * min(left, machine()))


def learning(config: Config, arena: "Arena", worlds: int, at_once: int = 1) -> int:
    """Return the estimated bytes of a batch from that many worlds and of its copies and activations in learning.

    `at_once`: number of players that learn at the same time, as on a CPU.
    """
    numbers = sum(agent.observation_size + 2 * agent.action_size + 8 for agent in arena.agents)
    if config.learner.critic_input == "privileged":
        numbers += arena.privileged_size * len(arena.teams) + sum(agent.observation_size for agent in arena.agents)
    elif config.learner.critic_input != "own":
        sides = len(arena.teams) if config.learner.critic_input == "same" else 1
        numbers += sides * len(arena.teams) * sum(agent.observation_size for agent in arena.agents)
    wide = at_once * LAYERS * max(config.learner.architecture.hidden)
    return 4 * worlds * config.training.rollout_length * (COPIES * numbers + wide)


def is_short(error: BaseException) -> bool:
    """Return whether an error means that memory ran out, on any device."""
    text = str(error).lower()
    return not isinstance(error, StorageError | TooLarge) and (
        isinstance(error, MemoryError) or any(sign in text for sign in SIGNS)
    )


def of_program(compiled: Any) -> int:
    """Return the bytes that a compiled program needs, by XLA; a result that reuses an argument's memory counts once."""
    found = compiled.memory_analysis()
    if found is None:
        return 0
    parts = (found.argument_size_in_bytes, found.output_size_in_bytes, found.temp_size_in_bytes)
    return sum(parts) - found.alias_size_in_bytes


def fitting(worlds: int, needed: int, room: int) -> int:
    """Return the number of worlds that probably fit, if `worlds` need too much; memory is proportional to worlds.

    The result is rounded down to two significant digits. It is at most half of `worlds`, since the estimate may be too
    low if they did not fit.
    """
    fits = min(worlds // 2, int(worlds * room / needed)) if needed else worlds // 2
    unit = 10 ** max(0, len(str(fits)) - 2)
    return fits // unit * unit


def describe(config: Config, worlds: int, needed: int, room: int) -> str:
    """Return the message, one line, for training that ran out of memory."""
    fits = fitting(worlds, needed, room)
    cure = (
        f"about {fits:,} worlds would fit: set training.worlds = {fits}, or a smaller training.rollout_length"
        if fits >= 2
        else "set a smaller training.rollout_length"
    )
    return (
        f"{SHORT}: training.worlds × training.rollout_length = {worlds} × {config.training.rollout_length} needs"
        f" about {needed / 1e9:.1f} GB, and {room / 1e9:.1f} GB are there for it; {cure}; nothing is lost"
    )
