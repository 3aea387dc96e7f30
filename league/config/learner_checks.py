"""Checks of settings of learners that depend on who learns by which class."""

from typing import TYPE_CHECKING

from agents.settings import HAPPO, REMOVED
from league.config import flags
from league.config.schema import ConfigError, dotted, refuse

if TYPE_CHECKING:
    from league.config.experiment import Config


def check_learner_flags(config: "Config", given: flags.Given) -> None:
    """Raise ConfigError for a flag of HAPPO where no player learns by it. A file may have such keys: presets do."""
    if any(key[0] == "learner" for key in given):
        check_classes(config)
    classes = {player.class_ or config.learner.class_ for player in config.players} or {config.learner.class_}
    if HAPPO in classes:
        return
    for key in given:
        if key[0] == "learner" and key[1] not in ("class", "settings", "skill", "critic_input"):
            raise ConfigError(
                key,
                f"{dotted(key)} = {given[key]}: is a setting of {HAPPO}, and learner.class is {config.learner.class_};"
                f" give its own as --learner.settings.{key[-1]}",
            )


def check_classes(config: "Config") -> None:
    """Raise ConfigError if a player would learn by a learner that was removed."""
    named = {("learner", "class"): config.learner.class_}
    named |= {("players", str(i), "class"): player.class_ or "" for i, player in enumerate(config.players)}
    for key, name in named.items():
        if name in REMOVED:
            raise refuse(key, name, REMOVED[name])
