"""The rows with which a league begins, and what of a configuration must fit what the store holds already."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from league.config import experiment as configuration
from league.config.experiment import Config
from league.config.schema import ConfigError, refuse
from league.examine import roster, rules, scripts
from league.heirs import Misfit, forerunners, heritage
from storage.errors import NotAStore
from storage.records import League, Player
from storage.store import Store

if TYPE_CHECKING:
    from arenas.arena import Arena


def players_of(config: Config, arena: "Arena") -> list[Player]:
    """The players of a league as rows of its store."""
    teams = [team.name for team in arena.teams]
    return [
        Player(config.league, p.name, teams.index(p.team), p.role, arena.teams[teams.index(p.team)].roster, p.group)
        for p in roster(config, teams)
    ]


def create(store: Store, config: Config, arena: "Arena") -> None:
    """Write the league, its players and the scripted opponents; what exists already stays.

    Raises StorageError, before anything is written, where the league has players that contradict these.
    """
    from league.exchange import bring_in_trained
    from league.fits import examine_checkpoints
    from league.policies import add_scripts
    from league.query import Open

    players = players_of(config, arena)
    if config.league in {league.name for league in store.leagues()}:
        _examine_rosters(store, config, arena, players)
        examine_checkpoints(store, config, arena, players)
        gone = sorted({p.name for p in store.players(config.league)} - {p.name for p in players})
        if gone:
            raise ConfigError(
                ("players",),
                f"league {config.league} has players that the settings do not name ({', '.join(gone)}): name them in"
                " [[players]], or choose another league name",
            )
        store.add_players(players)  # refuses those that contradict what is there
    store.create_league(League(config.league, configuration.dumps(config)))
    store.add_players(players)
    add_scripts(store, config.league, arena, scripts(config, arena))
    if config.rating.trained:
        bring_in_trained(Open(store, config.league), arena.name)


def _examine_rosters(store: Store, config: Config, arena: "Arena", players: list[Player]) -> None:
    """A league's policies must fit: another arena can only go on with it if its teams are the same to them."""
    known = {p.name: p for p in store.players(config.league)}
    for player in players:
        kept = known.get(player.name)
        if kept is not None and kept.roster != player.roster:
            raise ConfigError(
                ("league",),
                f"league {config.league!r} cannot go on in {arena.name}: its player {kept.name} fits {kept.roster}, not"
                f" {player.roster}; choose another league name",
            )


def examine_heritage(where: str, config: Config, stages: list[list[Player]]) -> None:
    """Each stage's players must fit those from which they start; those of earlier stages are not there yet."""
    before = _forerunners(where, config)
    for number, players in enumerate(stages):
        try:
            heritage(players, before)
        except Misfit as error:
            key = ("stages", str(number), "arena") if config.stages else ("after",)
            told = f"stage {config.stages[number].name}" if config.stages else f"after {', '.join(config.after)}"
            raise ConfigError(key, f"{told}: {error}") from None
        before.insert(0, players)


def _forerunners(where: str, config: Config) -> list[Sequence[Player]]:
    """The players of what is named in `after`; a store that is not there yet has none."""
    if not config.after:
        return []
    try:
        with Store.open(where, blobs=config.storage.blobs) as store:
            return forerunners(store, config.after)
    except NotAStore:
        return forerunners(None, config.after)


def examine_beginning(where: str, config: Config, arena: "Arena") -> None:
    """A new league's players must be able to take over the networks of what is named in `after`."""
    from league.fits import examine_start

    players = players_of(config, arena)
    try:
        with Store.open(where, blobs=config.storage.blobs) as store:
            if config.league not in {league.name for league in store.leagues()}:
                examine_start(store, config, arena, players)
    except NotAStore:
        examine_start(None, config, arena, players)


def examine_victim(where: str, config: Config, arena: "Arena", brought: Sequence[str] = ()) -> None:
    """Whom players always meet must be there, come with the league or be `brought` into it."""
    from league.policies import script_titles

    victims = {(*key, "victim"): rule.victim for key, rule in rules(config, [team.name for team in arena.teams])}
    if not any(victims.values()):
        return
    begun = [f"{p.name}@0" for p in players_of(config, arena)]
    known = [*brought, *script_titles(arena, scripts(config, arena)), *begun]
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
