"""The request of a command line of `league run`: its options, and its flags over a file, a preset or the store."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from league.commands.options import STORE, options, positional
from league.config import experiment as configuration
from league.config import flags, presets, toml
from league.config import stages as parts
from league.config.durations import seconds
from league.config.experiment import Config
from league.config.flags import SplitArguments
from league.config.former_names import Former, deprecation, present_names
from league.config.schema import ConfigError, Key, settings
from league.config.stages import Stage
from league.queries.query import only_league
from league.state.curriculum_stage import course
from storage.errors import NotAStore
from storage.store import Store


def _lasts(value: str) -> None:
    if seconds(value) == 0:
        raise ValueError("must be longer than nothing")


@dataclass(frozen=True)
class RunOptions:
    """The league to run, and for how long. All settings can stand in the file."""

    file: str | None = positional(None)
    """A league.toml (see `league init`). Without one and without --preset: the league last run here."""
    preset: str | None = None
    """Settings to start from: quickstart, duel, alphastar, psro, sumo-by-team, ...; `league presets` lists all."""
    store: str = STORE
    """The store: a folder, or a URL such as sqlite:///runs/league.db or postgresql://host/league."""
    blobs: str | None = None
    """The place where the store keeps policies and recordings; the same as --storage.blobs."""
    duration: str | None = field(default=None, metadata={"flag": "for", "valid": _lasts})
    """Train for so long from now on, e.g. 10m, whatever the budget says."""
    steps: int | None = field(default=None, metadata={"low": 1})
    """Train for so many environment steps from now on, whatever the budget says."""
    workers: int | None = field(default=None, metadata={"low": 0, "high": 64})
    """Processes that train; the same as --workers.train."""
    devices: tuple[int, ...] = field(default=(), metadata={"low": 0})
    """The GPUs to use, by their numbers, e.g. 0,1 (none given: all that this process may use)."""
    detach: bool = False
    """Run in the background; `league status` and `league stop` reach it."""
    live: bool = False
    """Show every match that is recorded meanwhile, in a window, or in a browser where none can open."""


@dataclass(frozen=True)
class RunRequest:
    """The options and the settings, with the places where they were given, for errors that are found later."""

    options: RunOptions
    config: Config
    continued: bool  # whether this continues the league last run here
    help: bool
    text: str | None  # the TOML that the flags change
    source: str
    given: flags.Given
    former: Former  # keys of the text that are given by former names

    def with_location(self, error: ConfigError) -> ConfigError:
        """Return the error with the place where the setting was given: the flag, or the file and the line."""
        if flags.is_of(error.key, self.given):
            return flags.as_flag(error)
        if flags.is_of(parts.as_given(error.key, self.config.stages), self.given):
            return ConfigError(error.key, error.message)  # which names the stage
        if self.text is None or not error.key:
            return error
        key = self.former.get(error.key, error.key)
        return ConfigError(error.key, error.message, f"{toml.place(key, self.text, self.source)}: ")


def read(args: Sequence[str]) -> RunRequest:
    """Read a command line, and the file or store that it names. Raises ConfigError or StorageError, one line."""
    names = {flags.option(f) for f in settings(RunOptions)}

    def split(base: Config, stages: Sequence[Stage] = ()) -> SplitArguments:
        return flags.split(args, lambda key: _is_switch(key, base, stages))

    def settings_in(arguments: SplitArguments) -> dict[Key, str]:
        return {key: value for key, value in arguments.given.items() if not (len(key) == 1 and key[0] in names)}

    # The line is split twice. The settings of the arena decide whether a flag takes the word that follows, and the
    # arena depends on the file, preset or store that the line names. The first split only finds these.
    arguments = split(configuration.default())
    first = {key[0]: text for key, text in arguments.given.items() if len(key) == 1 and key[0] in names}
    league = arguments.given.get(("league",))
    text, source, preset = _under(arguments, first.get("preset"), first.get("store") or STORE, league)
    given = settings_in(arguments)
    table = {} if text is None else toml.parse(text, source)
    base = configuration.base_of(table, given, source, text) if text is not None else preset
    assert base is not None
    arguments = split(base, _stages(table, base))
    given = settings_in(arguments)
    for key in given:
        if key[0] != parts.KEY and flags.find(key, Config, base) is None:
            every = [*names, *(".".join(k) for k in flags.every(Config, base))]
            raise flags.unknown(key, every)
    own = arguments._replace(given={key: value for key, value in arguments.given.items() if key not in given})
    chosen = options(RunOptions, own, "run")
    of_stages = {key: text for key, text in given.items() if key[0] == parts.KEY}
    given, old_flags = flags.present({k: v for k, v in given.items() if k not in of_stages}, Config, base)
    over = _budgeted(chosen, given)
    old_flags |= present_names(flags.values(over, Config, base), Config, base)[1]
    over |= of_stages
    config = configuration.change(base, over) if text is None else configuration.loads(text, source, over)
    continued = text is not None and chosen.file is None
    former = {} if text is None else configuration.former_names(text, source)
    if deprecated := old_flags | ({} if continued else former):  # nobody typed what a store holds
        print(f"league: {deprecation(deprecated)}", file=sys.stderr)
    return RunRequest(chosen, config, continued, arguments.help, text, source, over, former)


def _stages(table: Mapping[str, Any], base: Config) -> Sequence[Stage]:
    """Return the stages of a file, or of a preset; none where the file's are invalid, which is told with their line."""
    if parts.KEY not in table:
        return base.stages
    try:
        return parts.read(table[parts.KEY])
    except ConfigError:
        return ()


def _is_switch(key: Key, base: Config, stages: Sequence[Stage]) -> bool | None:
    own = flags.is_switch(key, RunOptions)
    key, base = configuration.within(key, base, stages)
    return own if own is not None else flags.is_switch(key, Config, base)


def _under(
    arguments: SplitArguments, preset: str | None, store: str, league: str | None
) -> tuple[str | None, str, Config | None]:
    """Return what the flags change: the text of a file or of the league last run, with its name, or a preset."""
    if arguments.rest:
        file = arguments.rest[0]
        if preset is not None:
            presets.preset(preset)
            raise ConfigError(("preset",), f"give a file or --preset, not both: {file} and --preset {preset}")
        return configuration.read(Path(file)), file, None
    if preset is not None:
        base = presets.preset(preset)
        arena = arguments.given.get(("arena", "name"))
        if arena is not None and arena != base.arena.name:
            base = replace(base, arena=configuration.default(arena).arena)
        return None, "", base
    if ("arena", "name") in arguments.given:
        return None, "", configuration.default(arguments.given[("arena", "name")])
    blobs = arguments.given.get(("blobs",)) or arguments.given.get(("storage", "blobs"))
    try:
        with Store.open(store, blobs=blobs) as opened:
            if opened.leagues():
                last = only_league(opened) if league is None else league
                whole = course(opened, last) if league is None else None  # a stage continues as part of its curriculum
                kept = opened.league(whole.root if whole else last)
                return kept.config, f"{opened.where}, league {kept.name}", None
    except NotAStore:
        pass  # there is no store yet; if something else is there, creating a store fails with the reason
    return None, "", presets.preset("quickstart")


def _budgeted(chosen: RunOptions, given: flags.Given) -> dict[Key, str]:
    """Return the flags, with those of the run itself under the keys of the settings that they stand for."""
    over = dict(given)
    stands_for: dict[Key, tuple[str, str]] = {}
    if chosen.blobs is not None:
        stands_for["storage", "blobs"] = ("--blobs", chosen.blobs)
    if chosen.steps is not None:
        stands_for["budget", "steps"] = ("--steps", str(chosen.steps))
    if chosen.duration is not None:
        stands_for["budget", "training_time"] = ("--for", chosen.duration)
    if chosen.workers is not None:
        stands_for["workers", "train"] = ("--workers", str(chosen.workers))
    for key, (flag, value) in stands_for.items():
        if given.get(key, value) != value:
            raise ConfigError(key, f"{flag} {value} contradicts --{'.'.join(key)} {given[key]}: give one of them")
        over[key] = value
    if chosen.steps is not None or chosen.duration is not None:
        over.setdefault(("budget", "steps"), "none")
        over.setdefault(("budget", "training_time"), "none")
    return over
