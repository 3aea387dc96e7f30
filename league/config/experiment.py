"""The whole experiment as one frozen dataclass: league.toml, the command line and the run's record are all this.

`arena` holds the settings that the arena itself defines, so its keys depend on the arena that is named. Reading or
writing a configuration loads neither torch, jax nor mujoco; what only they know is checked by `league/examine.py`.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import arenas
from agents.settings import HappoConfig
from arenas.blame import blame, sources
from arenas.errors import ArenaError
from arenas.options import EngineName
from league.config import flags, toml
from league.config import stages as parts
from league.config.build import build
from league.config.durations import seconds
from league.config.schema import ConfigError
from league.config.sections import (
    Budget,
    PlayerSettings,
    Rating,
    Storage,
    Training,
    Workers,
    check_name,
    named_players,
)
from matchmaking.opponents.settings import BY_RATINGS, Opponents
from matchmaking.pbt import Pbt, check_pbt
from matchmaking.roles import MAIN, Role, check_roles, role_named
from storage.records import Player

PRESET = "preset"
"""The key of a file that names the settings under its own."""


@dataclass(frozen=True)
class Config:
    """A league."""

    league: str = field(default="main", metadata={"valid": check_name})
    """The league's name in its store."""
    seed: int = field(default=1, metadata={"low": 0, "high": 2**31 - 1})
    """Seeds everything that is random."""
    deterministic: bool = False
    """On a CPU, with a budget in steps: end byte for byte the same however often the league is killed. Turns then start
    from fresh worlds, and rating matches when training has ended; to the end of rating.quota these are the same too."""
    engine: EngineName = "auto"
    """Physics; auto: warp on an NVIDIA GPU, c elsewhere."""
    arena: Any = field(default_factory=lambda: arenas.settings("sumo-2v2"))
    """The game; `name` chooses it."""
    players: tuple[PlayerSettings, ...] = ()
    """Who learns: tables [[players]]; without any, each team has one main player, named after it."""
    roles: tuple[Role, ...] = ()
    """What players are: tables [[roles]], each with a name and what differs from the role that is there already; for
    opponents of its own [roles.opponents]."""
    training: Training = field(default_factory=Training)
    """How players learn."""
    learner: HappoConfig = field(default_factory=HappoConfig)
    """HAPPO."""
    rating: Rating = field(default_factory=Rating)
    """How snapshots are rated."""
    budget: Budget = field(default_factory=Budget)
    """When the league has had enough."""
    workers: Workers = field(default_factory=Workers)
    """Processes on this machine."""
    storage: Storage = field(default_factory=Storage)
    """What the store keeps, and where."""
    after: tuple[str, ...] = field(default=(), metadata={"valid": lambda names: [*map(check_name, names)]})
    """Leagues of this store, or policies that come with the league, from which the players here start; the nearest
    first."""
    stages: tuple[parts.Stage, ...] = field(default=(), metadata={"apart": True})
    """A curriculum: tables [[stages]] with what differs from the settings above, walked in their order."""

    def __post_init__(self) -> None:
        """Check what depends on several settings."""
        if not self.league:
            raise ValueError("league: must be a name")
        if self.deterministic:
            self._check_deterministic()
        rating, training = self.rating, self.training
        if rating.worlds % (2 * rating.pairings):
            raise ValueError(
                f"rating.worlds: must be a multiple of 2 × rating.pairings, {2 * rating.pairings};"
                " every pairing plays as many episodes on either side"
            )
        if rating.share == 0.0 and self.budget.success is not None:
            raise ValueError("rating.share: must be above 0 where budget.success is set, which is rated while training")
        chunk = self.learner.sequence or 1
        if training.rollout % chunk:
            fit = max(n for n in range(1, chunk) if training.rollout % n == 0)
            raise ValueError(
                f"learner.chunk: must divide training.rollout, {training.rollout}, where"
                f" learner.architecture.recurrent is set; use {fit}, or another rollout"
            )
        if training.worlds is not None:
            samples, of = training.worlds * training.rollout // chunk, " / chunk" if chunk > 1 else ""
            if self.learner.minibatches > samples:
                raise ValueError(f"learner.minibatches: a batch has only {samples} samples, worlds × rollout{of}")
            if training.opponents.share and training.opponents.groups > training.worlds:
                raise ValueError(f"training.opponents.groups: there are only {training.worlds} worlds to share")
        if training.devices > 1:
            self._check_devices()
        self._check_players()
        check_pbt(training.pbt, training.schedule.kind, self.deterministic, self.learner.kl_step is not None)
        check_roles(self.roles, [player.role for player in self.players])

    @property
    def milestones(self) -> dict[str, float]:
        """The rating's milestones in seconds of training; none in a deterministic league: it hangs on no clock."""
        return {} if self.deterministic else {mark: seconds(mark) for mark in self.rating.milestones}

    def role(self, name: str) -> Role:
        """The role of that name, with nothing left open."""
        return role_named(name, self.roles, self.training.opponents)

    def opponents(self, player: Player | PlayerSettings) -> Opponents:
        """Whom a player of the league meets."""
        return self.role(player.role).opponents or self.training.opponents

    def _check_devices(self) -> None:
        """Each device has as many worlds, and enough of them for what they are split into."""
        training, devices = self.training, self.training.devices
        if training.worlds is None:
            return
        each, rest = divmod(training.worlds, devices)
        if rest:
            raise ValueError(
                f"training.worlds: must be a multiple of training.devices, {devices}: take {each * devices} or"
                f" {(each + 1) * devices}"
            )
        if self.learner.minibatches > each * training.rollout:
            raise ValueError(f"learner.minibatches: each device has only {each * training.rollout} samples of a batch")
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
        if self.budget.train is not None:
            raise ValueError('budget.train: time runs differently every time; deterministic wants "none" here')

    def _check_players(self) -> None:
        """Names tell players apart in the whole league, and a group has one place for each team."""
        roster = named_players(self.players)
        name, count = Counter(p.name for p in roster).most_common(1)[0] if roster else ("", 0)
        if count > 1:
            raise ValueError(f"players: {count} are called {name}; give each a name of its own")
        (group, team), count = Counter((p.group, p.team) for p in roster).most_common(1)[0] if roster else (("", ""), 0)
        if count > 1:
            raise ValueError(f"players: group {group} has {count} of team {team}; one of each team learns together")


def stage(config: Config, number: int) -> Config:
    """The settings of one stage: a league of its own, `main.walk` for the stage `walk` of `main`.

    Its players start from those of the stages before it. A budget of the whole league bounds every stage. Raises
    ConfigError with the stage's key.
    """
    own = config.stages[number]
    named = [f"{config.league}.{each.name}" for each in config.stages]
    arena, last = arena_of(own.settings), number == len(config.stages) - 1
    budget = config.budget if last else replace(config.budget, rate="0s")
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
        key = (parts.KEY, str(number), *error.key)
        raise ConfigError(key, f"stage {own.name}: {error.message}") from None
    least = [n for n in (made.budget.steps, config.budget.steps) if n is not None]
    budget = replace(made.budget, steps=min(least, default=None))
    if not last and not budget.ends:
        raise ConfigError(
            (parts.KEY, str(number), "budget"),
            f"stage {own.name}: nothing ends it; give it budget.steps, budget.train, budget.success or budget.reward",
        )
    return replace(made, budget=budget)


def default(arena: str = "sumo-2v2") -> Config:
    """The default settings of a league in that arena. Raises ConfigError, one line, where the arena cannot be read."""
    try:
        return Config(arena=arenas.settings(arena))
    except ArenaError as error:
        raise ConfigError(("arena", "name"), str(error)) from None
    except (Exception, SystemExit) as error:  # a person's own file may do anything when it is read
        raise ConfigError(("arena", "name"), f"arena {arena}: {blame(error, sources(arena))}") from error


def arena_of(table: Mapping[str, Any]) -> str | None:
    """The arena that a configuration names, as any TOML reader would see it."""
    arena = table.get("arena")
    name = arena.get("name") if isinstance(arena, Mapping) else None
    return name if isinstance(name, str) else None


def base_of(table: Mapping[str, Any], given: flags.Given, source: str, text: str = "") -> Config:
    """The defaults that a file's keys and then the flags change: those of the arena and the preset that they name.

    Raises ConfigError where a flag names another arena than a file whose settings are for its own, and for a preset
    that is not there, with its line where the `text` is given.
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
    from league.config.presets import preset  # presets are made of this

    try:
        base = preset(str(table[PRESET]))
    except ConfigError as error:
        raise ConfigError(error.key, error.message, f"{toml.place(error.key, text, source)}: ") from None
    return base if name in (None, base.arena.name) else replace(base, arena=default(name).arena)


def loads(text: str, source: str = "league.toml", given: flags.Given | None = None) -> Config:
    """A configuration from TOML; what it leaves out is as in the defaults of the arena that it names.

    `given` holds the text of flags by their keys; a flag wins over the file. Raises ConfigError, one line that says
    where: the file and its line, or the flag.
    """
    given, table = given or {}, toml.parse(text, source)
    base = base_of(table, given, source, text)
    table.pop(PRESET, None)
    tables = table.pop(parts.KEY, None)
    merged = flags.merged(table, flags.values(given, Config, base))
    try:
        config = build(Config, merged, base)
        config = config if tables is None else replace(config, stages=parts.read(tables))
        for number in range(len(config.stages)):
            stage(config, number)  # each must be possible
        return config
    except ConfigError as error:
        if flags.is_of(error.key, given):
            raise flags.as_flag(error) from None
        raise ConfigError(error.key, error.message, f"{toml.place(error.key, text, source)}: ") from None


def change(base: Config, given: flags.Given) -> Config:
    """The configuration with what the flags say. Raises ConfigError."""
    name = given.get(("arena", "name"))
    if name is not None and name != base.arena.name:
        base = replace(base, arena=default(name).arena)
    try:
        return build(Config, flags.values(given, Config, base), base)
    except ConfigError as error:
        raise flags.as_flag(error) from None


def read(path: Path) -> str:
    """The text of a file of settings. Raises ConfigError where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not text in UTF-8"
        raise ConfigError((), f"cannot read {path}: {why}; `league init` writes a file to start from") from error


def load(path: Path) -> Config:
    """A configuration from a file."""
    return loads(read(path), str(path))


def dumps(config: Config) -> str:
    """The configuration as a commented file that `loads` reads back unchanged."""
    try:
        base = default(config.arena.name)
    except ConfigError:
        base = None  # settings that were never registered: nothing but themselves can be read with them
    return toml.dumps(config, base) + parts.written(config.stages)
