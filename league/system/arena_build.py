"""The arena of a league, built for this machine, and the number of worlds that suit it.

Imports JAX and physics only inside functions that use them, because light commands import this module too.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from league.config.experiment import Config
from league.state.team_exchange import as_made
from league.system import batch_sizes
from storage.records import Player

if TYPE_CHECKING:
    from arenas.arena import Arena


def worlds(config: Config) -> int:
    """Return the number of worlds that training simulates at once, a multiple of its devices; raises nothing."""
    devices, size = config.training.devices, batch_sizes.training(config.arena.name, backend())
    each = size if backend() == "gpu" else max(1, size // devices)  # ranks on a CPU share its cores
    return config.training.worlds or each * devices


def rating_batch(config: Config) -> batch_sizes.Batch:
    """Return the size of a batch of rating matches on this machine; raises nothing."""
    return batch_sizes.batch(config.rating, backend(), config.budget.by_rating)


def backend() -> str:
    """Return the default backend of JAX: cpu, gpu, ..."""
    import jax

    return jax.default_backend()


def build(config: Config, count: int, players: Sequence[Player] = ()) -> "Arena":
    """Return the league's arena for `count` worlds, as each worker builds it; buffers on a GPU depend on `count`.

    `players` are the players of the league.
    """
    where = config.buffers.where()
    arena = config.arena.build(engine=config.engine, worlds=count, threads=config.workers.threads, **where)
    return as_made(arena, players)


@dataclass(frozen=True)
class Built:
    """An arena of this process, with the configuration and the number of worlds for which it was built."""

    arena: "Arena"
    config: Config
    worlds: int

    def again(self, config: Config, count: int, players: Sequence[Player] = ()) -> "Arena":
        """Return an arena as `build` does, but reuse the existing one if a new one would be equal."""
        asked, had = (
            (each.arena, each.engine, each.buffers, each.workers.threads, worlds)
            for each, worlds in ((config, count), (self.config, self.worlds))
        )
        return as_made(self.arena, players) if asked == had else build(config, count, players)
