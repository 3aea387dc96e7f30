"""Whether the networks that settings ask for can go on from those that are there, found out by loading them.

Torch is imported within, which takes a second or two; a league that is new, or run as it was before, needs none of
this.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

from league import heirs
from league.config import experiment as configuration
from league.config.experiment import Config
from league.config.schema import ConfigError
from storage import arrays
from storage.errors import StorageError
from storage.records import Player
from storage.store import Store

if TYPE_CHECKING:
    from arenas.arena import Arena


def examine_checkpoints(store: Store, config: Config, arena: "Arena", players: list[Player]) -> None:
    """A player goes on with the networks that it has. Only other settings than those of the last run can be others.

    That is found out by loading; it needs torch, which takes a second or two to be imported.
    """
    try:
        before = configuration.loads(store.league(config.league).config)
    except ConfigError:
        before = None  # written by another version
    if before and (before.learner, before.players, before.arena) == (config.learner, config.players, config.arena):
        return
    from league.learners import new_learner

    on_cpu = _on_cpu(config)
    kept = store.newest_checkpoints(config.league)
    for player in players:
        if player.name not in kept:
            continue
        state = arrays.from_bytes(store.blobs.get(kept[player.name].digest))
        try:
            new_learner(on_cpu, arena, player).load(state)
        except ValueError as error:
            raise ConfigError(
                ("league",),
                f"league {config.league!r} cannot go on with these settings of its learner: {player.name}: {error}; go"
                " on with the settings that it had, or choose another league name",
            ) from None


def examine_start(store: Store | None, config: Config, arena: "Arena", players: list[Player]) -> None:
    """A league after others begins with networks that its players can have; that is found out by trying."""
    from league.learners import new_learner

    found = heirs.of(store, players, config.after, config.learner.critic_input)
    for player in players:
        try:
            heirs.start(store, new_learner(_on_cpu(config), arena, player), found[player.name])
        except StorageError as error:
            raise ConfigError(("after",), f"after: {player.name} of league {config.league!r} {error}") from None


def _on_cpu(config: Config) -> Config:
    """The settings for learners that are only tried on."""
    return replace(config, training=replace(config.training, device="cpu"))
