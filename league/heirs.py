"""Who starts from whom: how the players of a league take over actors and critics of leagues that came before it.

A frozen policy that comes with the league counts as a league of one player, which has no critic to hand on.

An agent goes on from an agent of its own robot's kind, of the nearest league that has one; where that has several they
are taken in turn. An agent of a kind that nobody has trained starts afresh. A policy whose observation or action has
other numbers is refused: that is a mistake in the settings.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from league import exchange
from league.config import toml
from storage import arrays
from storage.errors import StorageError, UnknownName
from storage.records import Player
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


FROZEN = "frozen"  # the role of a policy that comes with the league


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
    rosters = {(p.league, p.name): p.roster for league in before for p in league if p.role != FROZEN}
    return owner if owner is not None and rosters.get(owner) == player.roster else None


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


def forerunners(store: Store | None, named: Sequence[str]) -> list[Sequence[Player]]:
    """The players of each: of that league of the store, else of the policy of that name that comes with the league.

    Raises UnknownName where it is neither.
    """
    leagues = {league.name: store for league in store.leagues()} if store else {}
    for name in named:
        if name not in leagues and name not in exchange.trained():
            raise UnknownName("league or trained policy", name, [*leagues, *exchange.trained()])
    return [leagues[name].players(name) if name in leagues else [_frozen(name)] for name in named]


def _frozen(name: str) -> Player:
    about = exchange.read(exchange.find(name)).about
    return Player(name, about["name"], 0, FROZEN, about["roster"])


def of(
    store: Store | None, players: Sequence[Player], after: Sequence[str], critic_input: str = "own"
) -> dict[str, Heritage]:
    """What the players of a league start from, by what the store, if there is one, holds of what is named in `after`.

    A critic that saw something else starts afresh. Raises UnknownName as `forerunners` does, Misfit as `heritage`.
    """
    order = sorted(players, key=lambda p: (p.role != "main", p.team, p.name))
    return {
        name: each._replace(critic=None) if each.critic and _saw(store, each.critic[0]) != critic_input else each
        for name, each in heritage(order, forerunners(store, after), critic_input).items()
    }


def _saw(store: Store | None, league: str) -> str:
    """What the critics of a league of this store see."""
    assert store is not None  # a frozen policy has no critic
    learner = toml.parse(store.league(league).config, league).get("learner", {})
    return str(learner.get("critic_input", "own"))


def start(store: Store | None, learner: "Learner", heritage: Heritage) -> str | None:
    """Give a new learner the weights that are its player's by heritage; the name of the first one's checkpoint.

    Inputs that never moved where these were learnt say nothing at first (`agents.checkpoint.unmoved`).
    Raises StorageError where a player has no checkpoint yet, or one that is damaged or of another network.
    """
    owners = dict.fromkeys((s.league, s.player) for s in heritage.actors if s)
    kept = {owner: _state(store, *owner) for owner in owners}
    actors = [(kept[source[:2]][1], source.agent) if source else None for source in heritage.actors]
    try:
        learner.inherit(actors, kept[heritage.critic][1] if heritage.critic else None, elsewhere=True)
    except ValueError as error:
        raise StorageError(f"cannot go on from {' and '.join(f'{a} {b}' for a, b in owners)}: {error}") from None
    return next((name for name, _ in kept.values()), None)


def _state(store: Store | None, league: str, player: str) -> tuple[str, Mapping[str, np.ndarray]]:
    """A forerunner's name and its learner's state; of a frozen policy only what an actor takes over."""
    if store is None or league not in {known.name for known in store.leagues()}:
        return f"{league}/{player}", _thawed(exchange.read(exchange.find(league)))
    kept = store.checkpoint(league, player)
    if kept is None:
        raise StorageError(f"player {player} of league {league} has no checkpoint to start from")
    return f"{league}/{player}@{kept.iteration}", arrays.from_bytes(store.blobs.get(kept.digest))


def thaw_into(learner: "Learner", frozen: bytes, known: Mapping[str, np.ndarray]) -> None:
    """Give a learner the actors of a snapshot of its own roster.

    `known` says of how many decisions the statistics of observations are worth (`checkpoint.observed`). Raises
    ValueError as `Learner.load` does.
    """
    policies = arrays.from_bytes(frozen)
    state = {**_named(policies), **known}
    if "sharing" in (own := learner.state()):
        state["sharing"] = own["sharing"]
    learner.inherit([(state, i) for i in range(len(learner.actors))], None)


def _named(policies: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A snapshot's arrays by their names in a learner's state."""
    return {f"actor.{name.replace('/', '.', 1)}": array for name, array in policies.items()}


def _thawed(policy: exchange.Policy) -> dict[str, np.ndarray]:
    """A frozen policy's actors as in a learner's state. Where it normalises what it sees, its statistics weigh as much
    as the decisions that it learnt from in its last league, so that a first batch does not overthrow them.
    """
    state = _named(policy.arrays)
    for i in range(policy.about["roster"].count("+") + 1):
        trunk = f"actor.{i}.trunk.observation_"
        known = policy.about["steps"] if np.isfinite(state[f"{trunk}clip"]) else 0
        state[f"actor.{i}.observed"] = np.full_like(state[f"{trunk}mean"], known)
    return state
