"""Warm start: the players of a league take over actors and critics of earlier leagues.

An agent continues from an agent of the same kind of robot, of the nearest league that has one. Where sides are unlike,
agents that played another side are used only if no league has one that played its own. If the league has several, they
are used in turn; those of players that never learn only if there are no others. An agent of an untrained kind starts
from scratch. A policy with another size of observation or action is refused, because that is a mistake in the settings,
unless `after_parts` names the parts of the observation by which its network goes on (`observation_fit.py`).
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from arenas.rosters import bare, roster_agents, roster_side
from league.config import experiment, toml
from league.config.experiment import Config
from league.snapshots.transfer import arena_transfer
from league.snapshots.transfer.home_arena import HomeTeam
from league.snapshots.transfer.observation_fit import Fit, fit
from league.snapshots.transfer.predecessors import (
    FROZEN,
    actors_of,
    best_of,
    forerunners,
    home_of,
    settings_of,
    state_of,
)
from matchmaking.roles import FIXED
from storage.blobs import arrays
from storage.errors import StorageError
from storage.records import Player
from storage.store import Store

if TYPE_CHECKING:
    from agents.learner.happo import HappoLearner
    from arenas.arena import Arena


class Source(NamedTuple):
    """An agent of a player of another league."""

    league: str
    player: str
    agent: int  # in its team's order


class WarmStart(NamedTuple):
    """Sources of a player's warm start."""

    actors: tuple[Source | None, ...]  # for each of its agents; None starts from scratch
    critic: tuple[str, str] | None  # (league, player); None starts from scratch, with the value normaliser


class IncompatiblePolicy(ValueError):  # noqa: N818  (named after the policy)
    """A source policy with another size of observation or action than the league's agent of the same kind."""


def warm_starts(
    players: Sequence[Player], before: Sequence[Sequence[Player]], critic_input: str = "own", any_size: bool = False,
    own: Mapping[str, Sequence[Sequence[Player]]] | None = None,
) -> dict[str, WarmStart]:  # fmt: skip
    """Return the sources of each player; `before` are the players of other leagues, the nearest league first.

    `own` has what replaces `before` for players that have an `after` of their own.

    A critic and its value normaliser continue if all actors come from one player and that player had the same roster:
    then the critic's input fits. A critic that sees all teams needs equal rosters of all teams, and one that judges for
    all teams needs the same roster for each of them. A critic that sees the whole state starts from scratch, because
    another arena has another state. With `any_size`, observations may have other sizes: `start` then says whether a
    network can be made for them. Raises IncompatiblePolicy, one line with both sizes.
    """
    taken: Counter[tuple[Source, ...]] = Counter()  # how many agents have one of these sources already
    found = {}
    for player in players:
        side, leagues = roster_side(player.roster), (own or {}).get(player.name, before)
        actors = tuple(_source(agent, side, leagues, taken, any_size) for agent in roster_agents(player.roster))
        critic = _critic(player, actors, leagues)
        if critic and not _fits(critic_input, player, players, *_of(leagues, critic)):
            critic = None
        found[player.name] = WarmStart(actors, critic)
    return found


def _source(
    agent: str, side: str, before: Sequence[Sequence[Player]], taken: Counter[tuple[Source, ...]], any_size: bool
) -> Source | None:
    kind = _kind(agent)
    for sides in ({side, ""}, None):
        for league in before:
            able = {
                Source(player.league, player.name, i): (other, player.role == FIXED.name)
                for player in sorted(league, key=lambda p: (p.role != "main", p.team, p.name))
                for i, other in enumerate(roster_agents(player.roster))
                if _kind(other) == kind and (not side or sides is None or roster_side(player.roster) in sides)
            }
            if able:
                known = tuple(source for source, (_, fixed) in able.items() if not fixed) or tuple(able)
                source = known[taken[known] % len(known)]
                taken[known] += 1
                _require_sizes(agent, able[source][0], source, any_size)
                return source
    return None


def _require_sizes(agent: str, other: str, source: Source, any_size: bool) -> None:
    if other != agent and not (any_size and _acts(other) == _acts(agent)):
        raise IncompatiblePolicy(
            f"{_kind(agent)} {_sizes(agent)} here, and {_sizes(other)} in {source.league}: give both the same"
            " observation (arena.buffer, say, in each stage), name the parts by which networks go on (after_parts),"
            " encode what differs in number as sets (learner.architecture.entities), or its players no forerunner"
        )


def takes_any_size(config: Config) -> bool:
    """Return whether networks of other leagues may have seen observations of other sizes."""
    return bool(config.learner.architecture.entities or config.after_parts)


def _critic(
    player: Player, actors: Sequence[Source | None], before: Sequence[Sequence[Player]]
) -> tuple[str, str] | None:
    owners = {(source.league, source.player) if source else None for source in actors}
    owner = owners.pop() if len(owners) == 1 else None
    rosters = {(p.league, p.name): bare(p.roster) for league in before for p in league if p.role != FROZEN}
    return owner if owner is not None and rosters.get(owner) == bare(player.roster) else None


def _of(before: Sequence[Sequence[Player]], owner: tuple[str, str]) -> tuple[Player, Sequence[Player]]:
    """Return a player of an earlier league, and all players of that league."""
    return next((p, league) for league in before for p in league if (p.league, p.name) == owner)


def _fits(sees: str, player: Player, league: Sequence[Player], owner: Player, before: Sequence[Player]) -> bool:
    """Return whether the critic of `owner`, a player of another league, has the input that `player` needs."""
    if sees == "all":
        return _rosters(player, league) == _rosters(owner, before)
    if sees == "same":
        return {p.team: bare(p.roster) for p in league} == {p.team: bare(p.roster) for p in before}
    return sees == "own"


def _rosters(player: Player, league: Sequence[Player]) -> list[str]:
    """Return the rosters that a critic of all teams sees: its own, then those of the other teams in their order."""
    others = {p.team: bare(p.roster) for p in league if p.team != player.team}
    return [bare(player.roster), *(others[team] for team in sorted(others))]


def _kind(agent: str) -> str:
    return agent.partition(":")[0]


def _acts(agent: str) -> str:
    return agent.rpartition(":")[2]


def _sizes(agent: str) -> str:
    _, observation, action = agent.split(":")
    return f"sees {observation} numbers and acts with {action}"


def describe(starts: Mapping[str, WarmStart], store: Store | None = None) -> list[str]:
    """Describe the sources of every player in sentences.

    With a `store` they name the snapshots that are used instead of a player's newest state, and the reason.
    """
    owners = dict.fromkeys((s.league, s.player) for actors, _ in starts.values() for s in actors if s)
    older = {owner: found for owner in owners if store and (found := best_of(store, *owner))}

    def whose(source: Source) -> str:
        found = older.get(source[:2])
        return f"{source.league}'s {found[0].name if found else source.player}/{source.agent}"

    lines = [
        f"{league} hands on {best.name}, the best snapshot of {player}: it {how}"
        for (league, player), (best, how) in older.items()
    ]
    for name, (actors, critic) in starts.items():
        sources = [whose(source) if source else "nothing" for source in actors]
        text = f"actors go on from {', '.join(sources)}" if any(actors) else "actors start afresh"
        value = f"critic and value normaliser from {critic[0]}'s {critic[1]}" if critic else "critic starts afresh"
        why = "" if critic or not any(actors) else " (no earlier one has its input)"
        lines.append(f"{name}: {text}; {value}{why}")
    return lines


def changed_actions(store: Store, config: Config) -> list[str]:
    """Return a line for each kind of robot whose sources learnt where the same action means something else.

    The league must have its players. Arenas are built: see `arena_transfer.changed_actions`.
    """
    starts = of_config(store, store.players(config.league), config)
    rosters = {p.name: roster_agents(p.roster) for p in store.players(config.league)}
    kinds: dict[str, dict[str, None]] = {}
    for name, (actors, _) in starts.items():
        for agent, source in zip(rosters[name], actors, strict=True):
            if source:
                kinds.setdefault(source.league, {})[_kind(agent)] = None
    here = experiment.dumps(config, comments=False)
    return [
        f"{league}: {line}"
        for league, found in kinds.items()
        for line in arena_transfer.changed_actions(settings_of(store, league), here, list(found))
    ]


def of(
    store: Store | None, players: Sequence[Player], after: Sequence[str], critic_input: str = "own",
    any_size: bool = False, own: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, WarmStart]:  # fmt: skip
    """Return the sources of the players of a league, among the leagues and policies named in `after`.

    `store` is None for a new store. A critic with another kind of input starts from scratch. `any_size` is that of
    `warm_starts`, and `own` has the names for players that have an `after` of their own. Raises UnknownName as
    `forerunners` does, IncompatiblePolicy as `warm_starts` does.
    """
    order = sorted(players, key=lambda p: (p.role != "main", p.team, p.name))
    theirs = {name: forerunners(store, names) for name, names in (own or {}).items()}
    return {
        name: each._replace(critic=None) if each.critic and _saw(store, each.critic[0]) != critic_input else each
        for name, each in warm_starts(order, forerunners(store, after), critic_input, any_size, theirs).items()
    }


def of_config(store: Store | None, players: Sequence[Player], config: Config) -> dict[str, WarmStart]:
    """Return the sources of the players of a league with these settings, as `of` does."""
    return of(store, players, config.after, config.learner.critic_input, takes_any_size(config), config.own_after)


def _saw(store: Store | None, league: str) -> str:
    """Return the kind of input of the critics of a league of this store."""
    assert store is not None  # a frozen policy has no critic
    learner = toml.parse(store.league(league).config, league).get("learner", {})
    return str(learner.get("critic_input", "own"))


def fits(
    named: Sequence[str], sources: WarmStart, arena: "Arena", team: int, home: Callable[[str, str], HomeTeam]
) -> tuple[Fit | None, ...]:
    """Return for each agent of a team how its source's network is fitted to its observation; None: it stays as it is.

    Args:
        named: the parts by which networks go on, `after_parts` of the settings; without any no network is fitted.
        sources: those of the team's player.
        arena: the arena in which the player is to learn.
        team: the player's team in it.
        home: gives the team for which a player of a league learnt, see `predecessors.home_of`.

    Raises:
        IncompatiblePolicy: the observations have no such parts, or an arena does not name its own; one line.
    """
    found: list[Fit | None] = []
    for agent, source in zip(arena.teams[team].agents, sources.actors, strict=True):
        if source is None or not named:
            found.append(None)
            continue
        try:
            there, here = home(source.league, source.player), arena.observation_parts(agent.name)
            if not (there.agents[source.agent].parts and here):
                raise ValueError(f"{arena.name if not here else there.arena} does not name the parts of observations")
            found.append(fit(there.agents[source.agent].parts, here, named))
        except ValueError as error:
            raise IncompatiblePolicy(f"after_parts: {agent.kind} of {source.league}: {error}") from None
    return tuple(found)


def fits_of(
    store: Store | None, config: Config, arena: "Arena", player: Player, sources: WarmStart
) -> tuple[Fit | None, ...]:
    """Return the fits of a player's sources in a league with these settings, as `fits` does, or raise StorageError."""
    return fits(config.after_parts, sources, arena, player.team, lambda league, name: home_of(store, league, name))


def fit_lines(store: Store, config: Config, arena: "Arena") -> list[str]:
    """Return a line for each fit of sources' networks to observations, with the agents that have it.

    The league must have its players.
    """
    players, agents = store.players(config.league), dict[str, list[str]]()
    starts = of_config(store, players, config)
    for player in players:
        for i, own in enumerate(fits_of(store, config, arena, player, starts[player.name])):
            if own is not None:
                agents.setdefault(str(own), []).append(f"{player.name}/{i}")
    return [f"by parts of their observations go on {', '.join(names)}; {own}." for own, names in agents.items()]


def start(
    store: Store | None, learner: "HappoLearner", sources: WarmStart, fitted: Sequence[Fit | None] = ()
) -> str | None:
    """Load the weights of a player's sources into a new learner, and return the name of the first source's checkpoint.

    Inputs that were constant during the earlier training are ignored at first
    (`checkpoint.with_constant_inputs_silenced`). `fitted` has the fits of the agents' networks, see `fits`. Raises
    StorageError if a player has no checkpoint yet, or one that is damaged or of another network.
    """
    owners = dict.fromkeys((s.league, s.player) for s in sources.actors if s)
    kept = {owner: state_of(store, *owner) for owner in owners}
    try:
        actors = [
            (_fitted(kept[source[:2]][1], source.agent, own), source.agent) if source else None
            for source, own in zip(sources.actors, fitted or [None] * len(sources.actors), strict=True)
        ]
        critic = None if any(fitted) else sources.critic  # of equal size and other parts, it would judge by wrong ones
        learner.warm_start(actors, kept[critic][1] if critic else None, from_other_arena=True)
    except ValueError as error:
        raise StorageError(f"cannot go on from {' and '.join(f'{a} {b}' for a, b in owners)}: {error}") from None
    return next((name for name, _ in kept.values()), None)


def _fitted(state: Mapping[str, np.ndarray], agent: int, own: Fit | None) -> Mapping[str, np.ndarray]:
    from agents.learner import checkpoint  # loads torch, as the learner has

    return state if own is None else checkpoint.with_inputs(checkpoint.upgrade_state(state), agent, own.places)


def thaw_into(learner: "HappoLearner", frozen: bytes, known: Mapping[str, np.ndarray]) -> None:
    """Give a learner the actors of a snapshot of its own roster.

    `known` has the number of decisions behind the statistics of observations (`checkpoint.observed`). Raises ValueError
    as `HappoLearner.load` does.
    """
    policies = arrays.from_bytes(frozen)
    state = {**actors_of(policies), **known}
    if "sharing" in (own := learner.save()):
        state["sharing"] = own["sharing"]
    learner.warm_start([(state, i) for i in range(len(learner.actors))], None)
