"""What a person asks `league run` for: its options, and the settings of a file, preset or store under its flags."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from league.commands.options import STORE, options, positional
from league.config import experiment as configuration
from league.config import flags, presets, toml
from league.config.durations import seconds
from league.config.experiment import Config
from league.config.flags import Words
from league.config.schema import ConfigError, Key, settings
from league.course import course
from league.query import only_league
from storage.errors import NotAStore
from storage.store import Store


def _lasts(value: str) -> None:
    if seconds(value) == 0:
        raise ValueError("must be longer than nothing")


@dataclass(frozen=True)
class RunOptions:
    """What to run, and for how long. All settings can stand in the file."""

    file: str | None = positional(None)
    """A league.toml (see `league init`). Without one and without --preset: the league last run here."""
    preset: str | None = None
    """Settings to start from: quickstart, duel, alphastar, psro, sumo-by-team, ...; an unknown one is told with all."""
    store: str = STORE
    """The store: a folder, or a URL such as sqlite:///runs/league.db or postgresql://host/league."""
    blobs: str | None = None
    """Where the store keeps policies and recordings; the same as --storage.blobs."""
    duration: str | None = field(default=None, metadata={"flag": "for", "valid": _lasts})
    """Train for so long from now on, e.g. 10m, whatever the budget says."""
    steps: int | None = field(default=None, metadata={"low": 1})
    """Train for so many environment steps from now on, whatever the budget says."""
    workers: int | None = field(default=None, metadata={"low": 1, "high": 64})
    """Processes that train; the same as --workers.train."""
    devices: tuple[int, ...] = field(default=(), metadata={"low": 0})
    """The GPUs to use, by their numbers, e.g. 0,1 (none given: all that this process may use)."""
    detach: bool = False
    """Run in the background; `league status` and `league stop` reach it."""


@dataclass(frozen=True)
class Asked:
    """The options, the settings, and where these stand, for what turns out later to be wrong with them."""

    options: RunOptions
    config: Config
    continued: bool  # the league that was last run here goes on
    help: bool
    text: str | None  # TOML under the flags
    source: str
    given: flags.Given

    def located(self, error: ConfigError) -> ConfigError:
        """The error with the place where the setting was given: the flag, or the file and the line."""
        if flags.is_of(error.key, self.given):
            return flags.as_flag(error)
        if self.text is None or not error.key:
            return error
        return ConfigError(error.key, error.message, f"{toml.place(error.key, self.text, self.source)}: ")


def read(args: Sequence[str]) -> Asked:
    """Read a command line, and the file or store that it is about. Raises ConfigError or StorageError, one line."""
    names = {flags.option(f) for f in settings(RunOptions)}

    def taken_apart(base: Config) -> Words:
        return flags.split(args, lambda key: _is_switch(key, base))

    # Which flags the arena has depends on its name, so the line is read twice: first for what chooses the arena.
    words = taken_apart(configuration.default())
    first = {key[0]: text for key, text in words.given.items() if len(key) == 1 and key[0] in names}
    league = words.given.get(("league",))
    text, source, preset = _under(words, first.get("preset"), first.get("store") or STORE, league)
    given = {key: value for key, value in words.given.items() if not (len(key) == 1 and key[0] in names)}
    base = configuration.base_of(toml.parse(text, source), given, source, text) if text is not None else preset
    assert base is not None
    words = taken_apart(base)
    given = {key: value for key, value in words.given.items() if not (len(key) == 1 and key[0] in names)}
    for key in given:
        if flags.find(key, Config, base) is None:
            every = [*names, *(".".join(k) for k in flags.every(Config, base))]
            raise flags.unknown(key, every)
    own = words._replace(given={key: value for key, value in words.given.items() if key not in given})
    chosen = options(RunOptions, own, "run")
    over = _budgeted(chosen, given)
    config = configuration.change(base, over) if text is None else configuration.loads(text, source, over)
    continued = text is not None and chosen.file is None
    return Asked(chosen, config, continued, words.help, text, source, over)


def _is_switch(key: Key, base: Config) -> bool | None:
    own = flags.is_switch(key, RunOptions)
    return own if own is not None else flags.is_switch(key, Config, base)


def _under(words: Words, preset: str | None, store: str, league: str | None) -> tuple[str | None, str, Config | None]:
    """What the flags are laid over: the text of a file or of the league last run and its name, or a preset."""
    if words.rest:
        file = words.rest[0]
        if preset is not None:
            presets.preset(preset)
            raise ConfigError(("preset",), f"give a file or --preset, not both: {file} and --preset {preset}")
        return configuration.read(Path(file)), file, None
    if preset is not None:
        base = presets.preset(preset)
        arena = words.given.get(("arena", "name"))
        if arena is not None and arena != base.arena.name:
            base = replace(base, arena=configuration.default(arena).arena)
        return None, "", base
    if ("arena", "name") in words.given:
        return None, "", configuration.default(words.given[("arena", "name")])
    blobs = words.given.get(("blobs",)) or words.given.get(("storage", "blobs"))
    try:
        with Store.open(store, blobs=blobs) as opened:
            if opened.leagues():
                last = only_league(opened) if league is None else league
                whole = course(opened, last) if league is None else None  # a stage goes on as part of its curriculum
                kept = opened.league(whole.root if whole else last)
                return kept.config, f"{opened.where}, league {kept.name}", None
    except NotAStore:
        pass  # nothing there yet; if it is something else, making a store there will say so
    return None, "", presets.quickstart()


def _budgeted(chosen: RunOptions, given: flags.Given) -> flags.Given:
    """The flags, with those of the run itself under the keys that they stand for."""
    over = dict(given)
    stands_for: dict[Key, tuple[str, str]] = {}
    if chosen.blobs is not None:
        stands_for["storage", "blobs"] = ("--blobs", chosen.blobs)
    if chosen.steps is not None:
        stands_for["budget", "steps"] = ("--steps", str(chosen.steps))
    if chosen.duration is not None:
        stands_for["budget", "train"] = ("--for", chosen.duration)
    if chosen.workers is not None:
        stands_for["workers", "train"] = ("--workers", str(chosen.workers))
    for key, (flag, value) in stands_for.items():
        if given.get(key, value) != value:
            raise ConfigError(key, f"{flag} {value} contradicts --{'.'.join(key)} {given[key]}: give one of them")
        over[key] = value
    if chosen.steps is not None or chosen.duration is not None:
        over.setdefault(("budget", "steps"), "none")
        over.setdefault(("budget", "train"), "none")
    return over
