"""Who starts from whom: how the players of a league take over actors and critics of leagues that came before it.

An agent goes on from an agent of its own robot's kind, of the nearest league that has one; where that has several they
are taken in turn. An agent of a kind that nobody has trained starts afresh. A policy whose observation or action has
other numbers is refused: that is a mistake in the settings.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from league.config import toml
from storage import arrays
from storage.errors import StorageError
from storage.records import Checkpoint, Player
from storage.store import Store

if TYPE_CHECKING:
    from agents.happo import Learner


class Source(NamedTuple):
    """An agent of a player of another league."""

    league: str
    player: str
    agent: int  # in its team's order


class Heritage(NamedTuple):
    """What a player starts from."""

    actors: tuple[Source | None, ...]  # for each of its agents; None starts afresh
    critic: tuple[str, str] | None  # league and player; None starts afresh, and so does the value normaliser


class Misfit(ValueError):  # noqa: N818  (a noun that says it)
    """A policy that should go on in a league whose agent of that kind has other numbers."""


def heritage(
    players: Sequence[Player], before: Sequence[Sequence[Player]], critic_input: str = "own"
) -> dict[str, Heritage]:
    """What each player starts from; `before` are the players of other leagues, the nearest league first.

    A critic and its value normaliser go on where the player it was of had the same roster and is the one from which
    all actors come: then its input fits. One that sees all teams needs the same rosters of all, and one that judges for
    all of them the same for each. One that sees the whole state starts afresh: another arena has another state. Raises
    Misfit, one line with both rosters.
    """
    taken: dict[str, int] = {}  # kind -> how many agents of it went on already
    found = {}
    for player in players:
        actors = tuple(_source(agent, before, taken) for agent in player.roster.split("+"))
        critic = _critic(player, actors, before)
        if critic and not _fits(critic_input, player, players, *_of(before, critic)):
            critic = None
        found[player.name] = Heritage(actors, critic)
    return found


def _source(agent: str, before: Sequence[Sequence[Player]], taken: dict[str, int]) -> Source | None:
    kind = _kind(agent)
    for league in before:
        able = [
            (Source(player.league, player.name, i), other)
            for player in sorted(league, key=lambda p: (p.role != "main", p.team, p.name))
            for i, other in enumerate(player.roster.split("+"))
            if _kind(other) == kind
        ]
        if able:
            source, other = able[taken.get(kind, 0) % len(able)]
            taken[kind] = taken.get(kind, 0) + 1
            if other != agent:
                raise Misfit(
                    f"{kind} {_told(agent)} here, and {_told(other)} in {source.league}: give both the same"
                    " observation (arena.buffer, say, in each stage), or its players no forerunner"
                )
            return source
    return None


def _critic(
    player: Player, actors: Sequence[Source | None], before: Sequence[Sequence[Player]]
) -> tuple[str, str] | None:
    owners = {(source.league, source.player) if source else None for source in actors}
    owner = owners.pop() if len(owners) == 1 else None
    rosters = {(p.league, p.name): p.roster for league in before for p in league}
    return owner if owner is not None and rosters[owner] == player.roster else None


def _of(before: Sequence[Sequence[Player]], owner: tuple[str, str]) -> tuple[Player, Sequence[Player]]:
    """A player of an earlier league, and all of that league."""
    return next((p, league) for league in before for p in league if (p.league, p.name) == owner)


def _fits(sees: str, player: Player, league: Sequence[Player], owner: Player, before: Sequence[Player]) -> bool:
    """Whether a critic of another league's player has the input that this one's is to have."""
    if sees == "all":
        return _rosters(player, league) == _rosters(owner, before)
    if sees == "same":
        return {p.team: p.roster for p in league} == {p.team: p.roster for p in before}
    return sees == "own"


def _rosters(player: Player, league: Sequence[Player]) -> list[str]:
    """What a critic that sees all teams sees: its own roster, then those of the other teams in their order."""
    others = {p.team: p.roster for p in league if p.team != player.team}
    return [player.roster, *(others[team] for team in sorted(others))]


def _kind(agent: str) -> str:
    return agent.partition(":")[0]


def _told(agent: str) -> str:
    _, observation, action = agent.split(":")
    return f"sees {observation} numbers and acts with {action}"


def words(heritages: Mapping[str, Heritage]) -> list[str]:
    """What each player starts from, as sentences; nothing is left unsaid."""
    lines = []
    for name, (actors, critic) in heritages.items():
        told = [f"{source.league}'s {source.player}/{source.agent}" if source else "nothing" for source in actors]
        whence = f"actors go on from {', '.join(told)}" if any(actors) else "actors start afresh"
        value = f"critic and value normaliser from {critic[0]}'s {critic[1]}" if critic else "critic starts afresh"
        why = "" if critic or not any(actors) else " (no earlier one has its input)"
        lines.append(f"{name}: {whence}; {value}{why}")
    return lines


def of(store: Store, players: Sequence[Player], after: Sequence[str], critic_input: str = "own") -> dict[str, Heritage]:
    """What the players of a league start from, by what the store holds of the leagues named in `after`.

    A critic that saw something else starts afresh. Raises UnknownName for a league that is not there, Misfit as
    `heritage` does.
    """
    for league in after:
        store.league(league)
    order = sorted(players, key=lambda p: (p.role != "main", p.team, p.name))
    found = heritage(order, [store.players(league) for league in after], critic_input)
    seen = {league: _critic_input(store, league) for league in after}
    return {
        name: each._replace(critic=None) if each.critic and seen[each.critic[0]] != critic_input else each
        for name, each in found.items()
    }


def _critic_input(store: Store, league: str) -> str:
    """What the critics of a league of this store see."""
    learner = toml.parse(store.league(league).config, league).get("learner", {})
    return str(learner.get("critic_input", "own"))


def start(store: Store, learner: "Learner", heritage: Heritage) -> str | None:
    """Give a new learner the weights that are its player's by heritage; the name of the first one's checkpoint.

    Raises StorageError where a player has no checkpoint yet, or one that is damaged or of another network.
    """
    owners = dict.fromkeys((s.league, s.player) for s in heritage.actors if s)
    kept = {owner: _checkpoint(store, *owner) for owner in owners}
    read = {owner: arrays.from_bytes(store.blobs.get(at.digest)) for owner, at in kept.items()}
    actors = [(read[source[:2]], source.agent) if source else None for source in heritage.actors]
    try:
        learner.inherit(actors, read[heritage.critic] if heritage.critic else None)
    except ValueError as error:
        raise StorageError(f"cannot go on from {' and '.join(f'{a} {b}' for a, b in owners)}: {error}") from None
    return next((f"{league}/{player}@{at.iteration}" for (league, player), at in kept.items()), None)


def _checkpoint(store: Store, league: str, player: str) -> Checkpoint:
    kept = store.checkpoint(league, player)
    if kept is None:
        raise StorageError(f"player {player} of league {league} has no checkpoint to start from")
    return kept
