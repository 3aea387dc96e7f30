"""Checks that the networks of a configuration can continue from existing ones, done by loading them.

Torch is imported within the functions, which takes a second or two. A league that is new, or that is run with the same
settings as before, needs no check.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

from league.config import experiment as configuration
from league.config.experiment import Config
from league.config.schema import ConfigError
from league.snapshots.transfer import warm_start
from storage.blobs import arrays
from storage.errors import StorageError
from storage.records import Player
from storage.store import Store

if TYPE_CHECKING:
    from arenas.arena import Arena


def validate_checkpoints(store: Store, config: Config, arena: "Arena", players: list[Player]) -> None:
    """Raise ConfigError if a player's networks cannot be loaded with these settings.

    Does nothing if learner, players and arena are as in the last run.
    """
    try:
        before = configuration.loads(store.league(config.league).config)
    except ConfigError:
        before = None  # written by another version of this program
    if before and (before.learner, before.players, before.arena) == (config.learner, config.players, config.arena):
        return
    from league.snapshots.transfer.skills import check_checkpoint
    from league.training.learner_factory import new_learner, skills_of
    from league.training.setback import PlayerDiverged

    on_cpu = _on_cpu(config)
    kept = store.newest_checkpoints(config.league)
    for player in players:
        if player.name not in kept:
            continue
        state = arrays.from_bytes(store.blobs.get(kept[player.name].digest))
        try:
            new_learner(on_cpu, arena, player).load(state)
            check_checkpoint(skills_of(on_cpu, arena, player), state)
        except (ValueError, PlayerDiverged) as error:
            raise ConfigError(
                ("league",),
                f"league {config.league!r} cannot continue with these settings of its learner: {player.name}: {error};"
                " use the settings that it had, or choose another league name",
            ) from None


def validate_start(store: Store | None, config: Config, arena: "Arena", players: list[Player]) -> None:
    """Raise ConfigError if a player cannot start from the networks that `after` names. Each network is tried."""
    from agents.learner.happo import HappoLearner
    from league.training.learner_factory import new_learner

    found = warm_start.of_config(store, players, config)
    for player in players:
        learner = new_learner(_on_cpu(config), arena, player)
        if not isinstance(learner, HappoLearner):  # it starts from nothing: `validate` refuses it an `after`
            continue
        try:
            fitted = warm_start.fits_of(store, config, arena, player, found[player.name])
            warm_start.start(store, learner, found[player.name], fitted)
        except warm_start.IncompatiblePolicy as error:
            raise ConfigError(("after_parts",), str(error)) from None
        except StorageError as error:
            raise ConfigError(("after",), f"after: {player.name} of league {config.league!r} {error}") from None


def _on_cpu(config: Config) -> Config:
    """Return the settings for learners that only serve a check."""
    return replace(config, training=replace(config.training, device="cpu"))
