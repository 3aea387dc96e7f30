"""What training takes of a device's memory: what is refused beforehand, and what is said where it was too much.

Nothing heavy is imported above: `prepare` asks before anything is built for good.
"""

import os
import resource
from pathlib import Path
from typing import TYPE_CHECKING, Any

from league.config.experiment import Config
from storage.errors import StorageError

if TYPE_CHECKING:
    from arenas.arena import Arena

SHARE = 0.8  # of what there is, which training may take
COPIES = 4  # of each number in a batch: as collected, cleaned, in what an actor learns from, and in the order of a pass
LAYERS = 3  # of the widest layer's numbers, in a pass of a whole batch: into it, its products, out of it
SIGNS = ("resource_exhausted", "out of memory", "can't allocate memory", "failed to allocate")  # JAX, torch, Warp
SHORT = "out of memory"  # so begins what is said of a turn that did not fit
CGROUP = Path("/sys/fs/cgroup/memory.max")


class TooLarge(Exception):  # noqa: N818  (a sentence: "the training is too large")
    """Training ran out of memory; the message is for the user, one line with what would fit."""


def machine() -> int:
    """Bytes of memory that this machine has, or its container."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        limit = CGROUP.read_text().strip()
    except OSError:
        return total
    return min(total, int(limit)) if limit.isdigit() else total


def room(device: Any) -> int:
    """Bytes that training may take from now on, of a torch device: what is free on a GPU, else of the machine.

    A limit that was put on this process (`ulimit -v`) counts too.
    """
    if device.type == "cuda":
        import torch

        return int(SHARE * torch.cuda.mem_get_info(device)[0])
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if limit != resource.RLIM_INFINITY else 0
    left = limit - pages * os.sysconf("SC_PAGE_SIZE") if pages else machine()
    return int(SHARE * min(left, machine()))


def learning(config: Config, arena: "Arena", worlds: int, at_once: int = 1) -> int:
    """Bytes of a batch from so many worlds with what learning makes of it, by the numbers that it holds.

    `at_once`: how many players learn at the same time, as on a CPU.
    """
    numbers = sum(agent.observation_size + 2 * agent.action_size + 8 for agent in arena.agents)
    if config.learner.critic_input == "privileged":
        numbers += arena.privileged_size * len(arena.teams) + sum(agent.observation_size for agent in arena.agents)
    elif config.learner.critic_input != "own":
        sides = len(arena.teams) if config.learner.critic_input == "same" else 1
        numbers += sides * len(arena.teams) * sum(agent.observation_size for agent in arena.agents)
    wide = at_once * LAYERS * max(config.learner.architecture.hidden)
    return 4 * worlds * config.training.rollout * (COPIES * numbers + wide)


def is_short(error: BaseException) -> bool:
    """Whether an error says that there was no memory left, on whatever device."""
    told = str(error).lower()
    return not isinstance(error, StorageError | TooLarge) and (
        isinstance(error, MemoryError) or any(sign in told for sign in SIGNS)
    )


def of_program(compiled: Any) -> int:
    """Bytes that a compiled program needs to run, as XLA counts them; what it gives in place of an argument once."""
    found = compiled.memory_analysis()
    if found is None:
        return 0
    parts = (found.argument_size_in_bytes, found.output_size_in_bytes, found.temp_size_in_bytes)
    return sum(parts) - found.alias_size_in_bytes


def fitting(worlds: int, needed: int, room: int) -> int:
    """How many worlds are likely to fit where so many needed too much: all that they need grows with their number.

    Two significant digits, rounded down; at most half of what did not fit, since then something was not counted.
    """
    fits = min(worlds // 2, int(worlds * room / needed)) if needed else worlds // 2
    unit = 10 ** max(0, len(str(fits)) - 2)
    return fits // unit * unit


def words(config: Config, worlds: int, needed: int, room: int) -> str:
    """What is said of training that ran out of memory, in one line."""
    fits = fitting(worlds, needed, room)
    cure = (
        f"about {fits:,} worlds would fit: set training.worlds = {fits}, or a smaller training.rollout"
        if fits >= 2
        else "set a smaller training.rollout"
    )
    return (
        f"{SHORT}: training.worlds × training.rollout = {worlds} × {config.training.rollout} needs"
        f" about {needed / 1e9:.1f} GB, and {room / 1e9:.1f} GB are there for it; {cure}; nothing is lost"
    )
