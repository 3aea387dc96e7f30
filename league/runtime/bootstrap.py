"""The rows with which a league begins, and the checks of a configuration against the contents of the store."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING

from league.config import experiment as configuration
from league.config.experiment import Config
from league.config.schema import ConfigError, refuse
from league.runtime.validation import roster, rules, scripts
from league.snapshots.transfer.home_arena import HomeTeam, team_in
from league.snapshots.transfer.predecessors import forerunners
from league.snapshots.transfer.warm_start import IncompatiblePolicy, WarmStart, fits, takes_any_size, warm_starts
from storage.errors import NotAStore
from storage.records import League, Player
from storage.store import Store

if TYPE_CHECKING:
    from arenas.arena import Arena


def players_of(config: Config, arena: "Arena") -> list[Player]:
    """Return the players of a league as rows of its store."""
    teams = [team.name for team in arena.teams]
    return [
        Player(config.league, p.name, teams.index(p.team), p.role, arena.teams[teams.index(p.team)].roster, p.group)
        for p in roster(config, teams)
    ]


def create(store: Store, config: Config, arena: "Arena", config_toml: str | None = None) -> None:
    """Write the league, its players and the scripted opponents; rows that exist already stay.

    `config_toml` is the configuration as text, if the caller has it. Raises StorageError or ConfigError, before
    anything is written, if the league has other players or networks than these.
    """
    from league.queries.query import Open
    from league.runtime.checkpoint_compat import validate_checkpoints
    from league.snapshots.codec import add_scripts
    from league.snapshots.transfer.arena_transfer import bring_in_trained

    players = players_of(config, arena)
    if config.league in {league.name for league in store.leagues()}:
        _validate_rosters(store, config, arena, players)
        validate_checkpoints(store, config, arena, players)
        gone = sorted({p.name for p in store.players(config.league)} - {p.name for p in players})
        if gone:
            raise ConfigError(
                ("players",),
                f"league {config.league} has players that the settings do not name ({', '.join(gone)}): name them in"
                " [[players]], or choose another league name",
            )
        store.add_players(players)  # refuses players that contradict those of the store
    text = configuration.dumps(config) if config_toml is None else config_toml
    store.create_league(League(config.league, text))
    store.add_players(players)
    add_scripts(store, config.league, arena, scripts(config, arena))
    if config.rating.trained:
        bring_in_trained(Open(store, config.league), arena)


def _validate_rosters(store: Store, config: Config, arena: "Arena", players: list[Player]) -> None:
    """Raise ConfigError if the arena's teams do not fit the league's policies; another arena's teams may fit."""
    known = {p.name: p for p in store.players(config.league)}
    for player in players:
        kept = known.get(player.name)
        if kept is not None and kept.roster != player.roster:
            raise ConfigError(
                ("league",),
                f"league {config.league!r} cannot go on in {arena.name}: its player {kept.name} fits {kept.roster}, not"
                f" {player.roster}; give it another league, --league NAME",
            )


def validate_stage_starts(where: str, config: Config, stages: "Sequence[tuple[Config, Arena]]") -> None:
    """Raise ConfigError if a stage's players do not fit those from which they start.

    `stages` are the settings and the arena of each stage, of the league itself if it has none. The players of earlier
    stages are taken from there, since the store does not have them yet. Nothing is checked once all players of the last
    stage have checkpoints: a file that `after` names may be gone then.
    """
    if _has_begun(where, config):
        return
    with _opened(where, config) as store:
        before = forerunners(store, config.after)
        own = [{name: forerunners(store, names) for name, names in stage.own_after.items()} for stage, _ in stages]
    earlier: dict[tuple[str, str], tuple[Player, Arena]] = {}
    for number, (stage, arena) in enumerate(stages):
        players = players_of(stage, arena)
        try:
            found = warm_starts(players, before, any_size=takes_any_size(stage), own=own[number])
            for player in players:
                _validate_fits(stage, arena, player, found[player.name], earlier)
        except IncompatiblePolicy as error:
            key = ("stages", str(number), "arena") if config.stages else ("after",)
            what = f"stage {config.stages[number].name}" if config.stages else f"after {', '.join(config.every_after)}"
            raise ConfigError(key, f"{what}: {error}") from None
        before.insert(0, players)
        earlier |= {(player.league, player.name): (player, arena) for player in players}


def _validate_fits(
    stage: Config, arena: "Arena", player: Player, start: WarmStart,
    earlier: "Mapping[tuple[str, str], tuple[Player, Arena]]",
) -> None:  # fmt: skip
    """Raise IncompatiblePolicy if networks of players of earlier stages cannot be fitted to a stage's observations."""

    def home(league: str, name: str) -> HomeTeam:
        other, there = earlier[league, name]
        return team_in(there, other.roster)

    of_stages = tuple(each if each and each[:2] in earlier else None for each in start.actors)
    fits(stage.after_parts, start._replace(actors=of_stages), arena, player.team, home)


def _has_begun(where: str, config: Config) -> bool:
    """Return whether every player of the league, or of a curriculum's last stage, has a checkpoint to resume from."""
    last = configuration.stage(config, len(config.stages) - 1) if config.stages else config
    try:
        with Store.open(where, blobs=config.storage.blobs) as store:
            players = store.players(last.league)
            return bool(players) and store.newest_checkpoints(last.league).keys() >= {p.name for p in players}
    except NotAStore:
        return False


@contextmanager
def _opened(where: str, config: Config) -> Iterator[Store | None]:
    """Open the store at `where`; None if it does not exist yet, and so has no leagues."""
    with ExitStack() as stack:
        store = None
        with suppress(NotAStore):
            store = stack.enter_context(Store.open(where, blobs=config.storage.blobs))
        yield store


def validate_first_start(where: str, config: Config, arena: "Arena") -> None:
    """Raise ConfigError if a new league's players cannot start from the networks that `after` names."""
    from league.runtime.checkpoint_compat import validate_start

    players = players_of(config, arena)
    try:
        with Store.open(where, blobs=config.storage.blobs) as store:
            if config.league not in {league.name for league in store.leagues()}:
                validate_start(store, config, arena, players)
    except NotAStore:
        validate_start(None, config, arena, players)


def validate_victims(where: str, config: Config, arena: "Arena", imported: Sequence[str] = ()) -> None:
    """Raise ConfigError if a fixed opponent is not in the league, does not come with it and is not `imported`."""
    from league.snapshots.codec import script_titles

    victims = {(*key, "victim"): rule.victim for key, rule in rules(config, [team.name for team in arena.teams])}
    if not any(victims.values()):
        return
    begun = [f"{p.name}@0" for p in players_of(config, arena)]
    known = [*imported, *script_titles(arena, scripts(config, arena)), *begun]
    try:
        with Store.open(where, blobs=config.storage.blobs) as store:
            if config.league in {league.name for league in store.leagues()}:
                known = list(dict.fromkeys([*known, *(s.name for s in store.snapshots(config.league))]))
    except NotAStore:
        pass
    for key, victim in victims.items():
        if victim and victim not in known:
            shown = ", ".join(known[:12]) + (", ..." if len(known) > 12 else "")
            raise refuse(key, victim, f"the league has no snapshot of that name; there are: {shown}")
