"""The whole experiment as one frozen dataclass, for league.toml, the command line and the record of a run.

`arena` holds the settings that the arena itself defines, so its keys depend on `arena.name`. Reading or writing a
configuration loads neither torch, jax nor mujoco; `league/runtime/validation.py` makes the checks that need them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import arenas
from agents.settings import HappoConfig
from arenas.arena_settings import EngineName
from arenas.errors import ArenaError, describe_error, source_files
from league.config import flags, toml
from league.config import stages as parts
from league.config.build import build
from league.config.durations import seconds
from league.config.former_names import Former, present_names
from league.config.schema import ConfigError, Key
from league.config.sections import (
    Budget,
    Buffers,
    PlayerSettings,
    Rating,
    Storage,
    Training,
    Workers,
    check_after_parts,
    check_forerunners,
    check_name,
    check_players,
    named_players,
)
from league.config.text_files import decoded
from matchmaking.opponents.settings import BY_RATINGS, Opponents
from matchmaking.pbt import Pbt, check_pbt
from matchmaking.roles import MAIN, Role, check_roles, role_named
from storage.records import Player

PRESET = "preset"
"""The key in a file that names a preset, whose settings the other keys of the file override."""
WORLDS = ("training", "worlds")


@dataclass(frozen=True)
class Config:
    """A league."""

    league: str = field(default="main", metadata={"valid": check_name})
    """The league's name in its store."""
    seed: int = field(default=1, metadata={"low": 0, "high": 2**31 - 1})
    """Seeds everything that is random."""
    deterministic: bool = False
    """On a CPU, with a budget in steps: end byte for byte the same however often the league is killed. Turns then start
    from fresh worlds, and rating matches when training has ended; until rating.episodes_per_pair are played these are
    the same too."""
    engine: EngineName = "auto"
    """Physics; auto: warp on an NVIDIA GPU, c elsewhere."""
    buffers: Buffers = field(default_factory=Buffers)
    """Warp's buffers, where the arena's own are too small."""
    arena: Any = field(default_factory=lambda: arenas.settings("sumo-2v2"))
    """The game; `name` chooses it."""
    players: tuple[PlayerSettings, ...] = ()
    """Players: tables [[players]]; without any, each team has one main player, named after it."""
    roles: tuple[Role, ...] = ()
    """Roles of players: tables [[roles]], each with a name and its differences from the built-in role of that name; for
    opponents of its own [roles.opponents]."""
    training: Training = field(default_factory=Training)
    """Training of players."""
    learner: HappoConfig = field(default_factory=HappoConfig)
    """HAPPO."""
    rating: Rating = field(default_factory=Rating)
    """Rating of snapshots."""
    budget: Budget = field(default_factory=Budget)
    """Conditions that end the league."""
    workers: Workers = field(default_factory=Workers)
    """Processes on this machine."""
    storage: Storage = field(default_factory=Storage)
    """Limits and places of what the store keeps."""
    after: tuple[str, ...] = field(default=(), metadata={"valid": check_forerunners})
    """Leagues of this store, snapshots of them (main/blue@49), policies that come with the league, or files that
    `league export` wrote (my/policy.safetensors), from which the players here start; the nearest first."""
    after_parts: tuple[str, ...] = field(default=(), metadata={"valid": check_after_parts})
    """Parts of observations by which networks go on from `after` and earlier stages where observations differ: names,
    THERE=HERE for another name here, "*" for all of equal name and size (none: such networks are refused)."""
    stages: tuple[parts.Stage, ...] = field(default=(), metadata={"apart": True})
    """A curriculum: tables [[stages]] with what differs from the settings above, walked in their order."""

    def __post_init__(self) -> None:
        """Check conditions that involve several settings; raises ValueError."""
        if not self.league:
            raise ValueError("league: must be a name")
        if self.deterministic:
            self._check_deterministic()
        rating, training = self.rating, self.training
        rules = [self.role(name).opponents for name in {p.role for p in self.players} | {MAIN.name}]
        if not self.workers.match and any(rule is not None and rule.await_matches for rule in rules):
            raise ValueError("training.opponents.await_matches: nobody plays the matches; give workers.match 1 or more")
        if rating.share == 0.0 and self.budget.by_rating:
            names = [n for n in ("success", "score", "plateau") if getattr(self.budget, n) is not None]
            why = f"where budget.{names[0]} is set, which is rated while training"
            raise ValueError(f"rating.share: must be above 0 {why}")
        if self.budget.against and self.budget.score is None and self.budget.plateau is None:
            raise ValueError("budget.against: is for budget.score or budget.plateau; set one of them")
        chunk = self.learner.sequence or 1
        if training.rollout_length % chunk:
            fit = max(n for n in range(1, chunk) if training.rollout_length % n == 0)
            raise ValueError(
                f"learner.chunk_length: must divide training.rollout_length, {training.rollout_length}, where"
                f" learner.architecture.recurrent is set; use {fit}, or another rollout length"
            )
        if training.rollout_length % (every := self.learner.skill.clock):
            raise ValueError(
                f"learner.skill.every: must divide training.rollout_length, {training.rollout_length}: a rollout is a"
                " whole number of commands"
            )
        if training.worlds is not None:
            samples, of = training.worlds * training.rollout_length // chunk, " / chunk_length" if chunk > 1 else ""
            samples, of = (samples // every, " / learner.skill.every") if every > 1 else (samples, of)
            if self.learner.minibatches > samples:
                raise ValueError(
                    f"learner.minibatches: a batch has only {samples} samples, worlds × rollout_length{of}"
                )
            if training.opponents.share and training.opponents.groups > training.worlds:
                raise ValueError(f"training.opponents.groups: there are only {training.worlds} worlds to share")
        if training.devices > 1:
            self._check_devices()
        check_players(self.players)
        check_pbt(training.pbt, training.schedule.kind, self.deterministic, self.learner.desired_kl is not None)
        check_roles(self.roles, [player.role for player in self.players])

    @property
    def milestones(self) -> dict[str, float]:
        """The rating's milestones in seconds of training; none in a deterministic league, which depends on no clock."""
        return {} if self.deterministic else {mark: seconds(mark) for mark in self.rating.milestones}

    def role(self, name: str) -> Role:
        """Return the role of that name, with all values filled in."""
        return role_named(name, self.roles, self.training.opponents)

    def opponents(self, player: Player | PlayerSettings) -> Opponents:
        """Return the opponent settings of a player of the league."""
        return self.role(player.role).opponents or self.training.opponents

    @property
    def own_after(self) -> dict[str, tuple[str, ...]]:
        """`after` of each player that has one of its own."""
        return {each.name: each.after for each in named_players(self.players) if each.after is not None}

    @property
    def every_after(self) -> tuple[str, ...]:
        """The names of all that some player starts from, each once."""
        return tuple(dict.fromkeys([*self.after, *(name for own in self.own_after.values() for name in own)]))

    @property
    def afresh(self) -> "Config":
        """The same settings for players that all start from nothing."""
        return replace(self, after=(), players=tuple(replace(each, after=None) for each in self.players))

    def _check_devices(self) -> None:
        """Check that all devices get equally many worlds, and enough for minibatches and groups; raises ValueError."""
        training, devices = self.training, self.training.devices
        if training.worlds is None:
            return
        each, rest = divmod(training.worlds, devices)
        if rest:
            raise ValueError(
                f"training.worlds: must be a multiple of training.devices, {devices}: take {each * devices} or"
                f" {(each + 1) * devices}"
            )
        if self.learner.minibatches > each * training.rollout_length:
            raise ValueError(
                f"learner.minibatches: each device has only {each * training.rollout_length} samples of a batch"
            )
        if training.opponents.share and training.opponents.groups > each:
            raise ValueError(f"training.opponents.groups: each device has only {each} worlds to share")

    def _check_deterministic(self) -> None:
        for name in {p.role for p in self.players} | {MAIN.name}:
            rule = self.role(name).opponents
            if rule is not None and rule.kind in BY_RATINGS:
                raise ValueError(
                    f"deterministic: opponents.kind = {rule.kind!r} follows ratings, whose matches end in no fixed"
                    " order; use another kind"
                )
        if self.budget.steps is None:
            raise ValueError("deterministic: needs a budget in steps; give budget.steps, or --steps")
        if self.budget.training_time is not None:
            raise ValueError('budget.training_time: time runs differently every time; deterministic wants "none" here')


def stage(config: Config, number: int) -> Config:
    """Return the settings of one stage: a league of its own, `main.walk` for the stage `walk` of `main`.

    The players of a stage start from the players of the stages before it. A budget of the whole league bounds every
    stage. Raises ConfigError with the stage's key.
    """
    own = config.stages[number]
    named = [f"{config.league}.{each.name}" for each in config.stages]
    arena, last = arena_of(own.settings), number == len(config.stages) - 1
    budget = config.budget if last else replace(config.budget, rating_time="0s")
    after = (*reversed(named[:number]), *config.after)
    base = replace(config, league=named[number], stages=(), after=after, budget=budget)
    if not last:
        base = replace(base, players=(), training=replace(base.training, pbt=Pbt()))
    try:
        if arena is not None and arena != config.arena.name:
            base = replace(base, arena=default(arena).arena)
        made = build(Config, own.settings, base)
        if made.learner.architecture != config.learner.architecture:
            raise ConfigError(
                ("learner", "architecture"), "learner.architecture: must be the same in all stages, which share actors"
            )
    except ConfigError as error:
        raise parts.of_stage(error, number, config.stages) from None
    budget = made.budget.within(config.budget)
    if not last and not budget.ends:
        raise ConfigError(
            (parts.KEY, str(number), "budget"),
            f"stage {own.name}: nothing ends it; give it budget.steps, budget.training_time, budget.success,"
            " budget.score, budget.plateau or budget.reward",
        )
    return replace(made, budget=budget)


def default(arena: str = "sumo-2v2") -> Config:
    """Return the default settings of a league in that arena. Raises ConfigError, one line, for a bad arena."""
    try:
        return Config(arena=arenas.settings(arena))
    except ArenaError as error:
        raise ConfigError(("arena", "name"), str(error)) from None
    except (Exception, SystemExit) as error:  # a user's own arena file may do anything on import
        raise ConfigError(("arena", "name"), f"arena {arena}: {describe_error(error, source_files(arena))}") from error


def arena_of(table: Mapping[str, Any]) -> str | None:
    """Return the name of the arena in a parsed TOML table, or None."""
    arena = table.get("arena")
    name = arena.get("name") if isinstance(arena, Mapping) else None
    return name if isinstance(name, str) else None


def base_of(table: Mapping[str, Any], given: flags.Given, source: str, text: str = "") -> Config:
    """Return the defaults of the named arena and preset, which the keys of the file and then the flags override.

    Raises ConfigError if a flag and the file name different arenas, and for an unknown preset, with its line if `text`
    is given.
    """
    asked, named = given.get(("arena", "name")), arena_of(table)
    if asked is not None and named is not None and asked != named:
        raise ConfigError(
            ("arena", "name"),
            f'--arena.name {asked} contradicts arena.name = "{named}" in {source}: change it there, or leave it out',
        )
    name = asked or named
    if PRESET not in table:
        return default() if name is None else default(name)
    from league.config.presets import preset  # late, because presets import this module

    try:
        base = preset(str(table[PRESET]))
    except ConfigError as error:
        raise ConfigError(error.key, error.message, f"{toml.place(error.key, text, source)}: ") from None
    return base if name in (None, base.arena.name) else replace(base, arena=default(name).arena)


def loads(
    text: str, source: str = "league.toml", given: flags.Given | None = None, over: Mapping[str, Any] | None = None
) -> Config:
    """Read a configuration from TOML; missing keys have the defaults of the named arena.

    `given` holds the text of flags by their keys; a flag overrides the file. So do `over`, tables of values. Raises
    ConfigError, one line with the place of the error: the file and its line, or the flag.
    """
    (given, of_stages), table = parts.apart(given or {}), flags.merged(toml.parse(text, source), over or {})
    base = base_of(table, given, source, text)
    table.pop(PRESET, None)
    former: Former = {}
    try:
        table, former = _present_names(table, base)
        tables = table.pop(parts.KEY, None)
        config = build(Config, flags.merged(table, flags.values(given, Config, base)), base)
        flags.check_learner_flags(config, given)
        config = config if tables is None else replace(config, stages=parts.read(tables))
        if flags.is_of(WORLDS, given) or flags.names(over or {}, WORLDS):
            config = replace(config, stages=tuple(_bounded(each, config.training.worlds) for each in config.stages))
        for number in range(len(config.stages)):
            stage(config, number)  # raises if a stage is invalid
    except ConfigError as error:
        if flags.is_of(error.key, given):
            raise flags.as_flag(error) from None
        key = former.get(error.key, error.key)
        if not text or flags.names(over or {}, key):
            raise ConfigError(error.key, error.message) from None
        raise ConfigError(error.key, error.message, f"{toml.place(key, text, source)}: ") from None
    return _with_stage_flags(config, of_stages)


def within(key: Key, base: Config, stages: Sequence[parts.Stage]) -> tuple[Key, Config]:
    """Return the key of a flag in its own league, and defaults there: `stages.walk.learner.lr` is `learner.lr` of the
    stage `walk`, which may have another arena.
    """
    if key[0] != parts.KEY or len(key) < 3:
        return key, base
    own = parts.find(key[1], stages)
    arena = arena_of(own.settings) if own else None
    return key[2:], base if arena in (None, base.arena.name) else replace(base, arena=default(arena).arena)


def _with_stage_flags(config: Config, of_stages: Mapping[str, flags.Given]) -> Config:
    """Return the configuration with flags over the settings of its stages. Raises ConfigError."""
    for name, given in of_stages.items():
        number = parts.number_of(name, config.stages)
        own = config.stages[number]
        arena = given.get(("arena", "name")) or arena_of(own.settings) or config.arena.name
        try:
            base = config if arena == config.arena.name else replace(config, arena=default(arena).arena)
            present, _ = flags.present(given, Config, base)
            settings = flags.merged(own.settings, flags.values(present, Config, base))
        except ConfigError as error:
            raise parts.refused(own, error) from None
        stages = (*config.stages[:number], replace(own, settings=settings), *config.stages[number + 1 :])
        config = replace(config, stages=stages)
        made = stage(config, number)  # raises if its settings are invalid now
        try:
            flags.check_learner_flags(made, present)
        except ConfigError as error:
            raise parts.refused(own, error) from None
    return config


def _bounded(own: parts.Stage, worlds: int | None) -> parts.Stage:
    """Return a stage with at most so many worlds. A flag, unlike the league's own table, has the last word."""
    training = own.settings.get(WORLDS[0])
    named = training.get(WORLDS[1]) if isinstance(training, Mapping) else None
    if worlds is None or not isinstance(named, int) or named <= worlds:
        return own
    return replace(own, settings=flags.merged(own.settings, {WORLDS[0]: {WORLDS[1]: worlds}}))


def former_names(text: str, source: str = "league.toml") -> Former:
    """Return the keys of a valid configuration's text that are given by former names, those of stages too."""
    table = toml.parse(text, source)
    return _present_names(table, base_of(table, {}, source, text))[1]


def _present_names(table: Mapping[str, Any], base: Config) -> tuple[dict[str, Any], Former]:
    """Return the tables of a file with the present names of all settings; stages hold settings of a league."""
    found, former = present_names(table, Config, base)
    stages = table.get(parts.KEY)
    if isinstance(stages, list):
        found[parts.KEY] = []
        for i, each in enumerate(stages):
            at = (parts.KEY, str(i))
            own, inner = present_names(each, Config, at=at) if isinstance(each, Mapping) else (each, {})
            found[parts.KEY].append(own)
            former |= inner
    return found, former


def change(base: Config, given: flags.Given) -> Config:
    """Return the configuration with the values of the flags. Raises ConfigError."""
    given, of_stages = parts.apart(given)
    name = given.get(("arena", "name"))
    if name is not None and name != base.arena.name:
        base = replace(base, arena=default(name).arena)
    try:
        config = build(Config, flags.values(given, Config, base), base)
        flags.check_learner_flags(config, given)
    except ConfigError as error:
        raise flags.as_flag(error) from None
    return _with_stage_flags(config, of_stages)


def read(path: Path) -> str:
    """Return the text of a settings file, with or without a byte-order mark. Raises ConfigError if it is unreadable."""
    hint = "`league init` writes a file to start from"
    try:
        return decoded(path.read_bytes(), str(path)).replace("\r\n", "\n")
    except OSError as error:
        raise ConfigError((), f"cannot read {path}: {error.strerror}; {hint}") from error
    except ConfigError as error:
        raise ConfigError((), f"{error.message}; {hint}") from error


def load(path: Path) -> Config:
    """Read a configuration from a file. Raises ConfigError."""
    return loads(read(path), str(path))


def dumps(config: Config, comments: bool = True) -> str:
    """Write the configuration as TOML, commented or not, that `loads` reads back unchanged."""
    try:
        base = default(config.arena.name)
    except ConfigError:
        base = None  # an arena that was never registered has no defaults
    return toml.dumps(config, base, comments) + parts.written(config.stages)
