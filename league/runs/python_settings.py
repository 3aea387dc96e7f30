"""A configuration from Python values: a mapping, a file, a preset's name, or settings by keyword."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from league.config import experiment, flags, presets
from league.config.experiment import Config
from league.config.schema import UNSET, ConfigError
from league.queries.query import only_league
from league.state.curriculum_stage import course
from storage.errors import NotAStore
from storage.store import Store

SOURCE = "settings"


def config_of(
    config: "Config | Mapping[str, Any] | str | os.PathLike[str] | None", settings: Mapping[str, Any], store: str
) -> Config:
    """Return a configuration.

    Args:
        config: a Config, a mapping such as a parsed league.toml, the path of a file, or the name of a preset; None for
            the league of the store that was run last, or the one that `settings` name, else the quick start.
        settings: settings over it, as nested mappings or with dotted keys; None unsets one.
        store: the store of the run.

    Raises ConfigError, one line with the key.
    """
    over = tables(settings)
    if config is None:
        config = _kept(store, over)
    if isinstance(config, Config):
        return experiment.loads(experiment.dumps(config), SOURCE, over=over) if over else config
    if isinstance(config, Mapping):
        return experiment.loads("", SOURCE, over=flags.merged(tables(config), over))
    if isinstance(config, str) and not config.endswith(".toml") and not Path(config).exists():
        return experiment.loads(experiment.dumps(presets.preset(config)), f"preset {config}", over=over)
    if not isinstance(config, (str, os.PathLike)):
        raise ConfigError((), f"no settings: {config!r}; give a mapping, a Config, the path of a TOML file or a preset")
    return experiment.loads(experiment.read(Path(config)), str(config), over=over)


def tables(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as the nested tables of a file: dotted keys are split, and values are those of TOML."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        own: Any = _plain(value)
        for part in reversed(str(name).split(".")):
            own = {part: own}
        found = flags.merged(found, own)
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return tables(value)
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    if value is None:
        return UNSET
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value.item() if hasattr(value, "item") and not getattr(value, "shape", ()) else value  # of NumPy


def _kept(store: str, over: Mapping[str, Any]) -> Config | Mapping[str, Any]:
    """Return the league that was run last in the store, unless `over` name a preset or an arena; else no settings."""
    if presets_or_arena(over):
        return {}
    storage = over.get("storage")
    try:
        with Store.open(store, blobs=storage.get("blobs") if isinstance(storage, Mapping) else None) as opened:
            names = [each.name for each in opened.leagues()]
            name = over.get("league") or (only_league(opened) if names else None)
            if name in names:
                whole = course(opened, name) if "league" not in over else None
                return experiment.loads(opened.league(whole.root if whole else name).config, f"league {name}")
    except NotAStore:
        pass
    return presets.preset("quickstart")


def presets_or_arena(over: Mapping[str, Any]) -> bool:
    """Return whether settings name a preset or an arena, and so begin afresh."""
    return experiment.PRESET in over or experiment.arena_of(over) is not None
