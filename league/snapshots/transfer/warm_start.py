"""Warm start: the players of a league take over actors and critics of earlier leagues.

A frozen policy that comes with the league counts as a league of one player without a critic, and so do a snapshot,
which `after` names as league/snapshot, and a file that `league export` wrote.

An agent continues from an agent of the same kind of robot, of the nearest league that has one. Where sides are unlike,
agents that played another side are used only if no league has one that played its own. If the league has several, they
are used in turn. An agent of an untrained kind starts from scratch. A policy with another size of
observation or action is refused, because that is a mistake in the settings.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from agents.policy.skill_arrays import PREFIX, strategy_of
from arenas.rosters import bare, roster_agents, roster_side
from league.config import experiment, toml
from league.config.experiment import Config
from league.config.sections import POLICY_FILE, Rating
from league.queries.league_settings import LeagueSettings
from league.scheduling.training_progress import handed_on
from league.snapshots import policy_file
from league.snapshots.transfer import arena_transfer
from league.state.league_state import LeagueState
from storage.blobs import arrays, programs
from storage.errors import StorageError, UnknownName
from storage.records import Player, Snapshot
from storage.store import Store

if TYPE_CHECKING:
    from agents.learner.happo import HappoLearner


class Source(NamedTuple):
    """An agent of a player of another league."""

    league: str
    player: str
    agent: int  # in its team's order


class WarmStart(NamedTuple):
    """Sources of a player's warm start."""

    actors: tuple[Source | None, ...]  # for each of its agents; None starts from scratch
    critic: tuple[str, str] | None  # (league, player); None starts from scratch, with the value normaliser


FROZEN = "frozen"  # the role of a policy that comes with the league, or from a file


class IncompatiblePolicy(ValueError):  # noqa: N818  (named after the policy)
    """A source policy with another size of observation or action than the league's agent of the same kind."""


def warm_starts(
    players: Sequence[Player], before: Sequence[Sequence[Player]], critic_input: str = "own", entities: bool = False,
    own: Mapping[str, Sequence[Sequence[Player]]] | None = None,
) -> dict[str, WarmStart]:  # fmt: skip
    """Return the sources of each player; `before` are the players of other leagues, the nearest league first.

    `own` has what replaces `before` for players that have an `after` of their own.

    A critic and its value normaliser continue if all actors come from one player and that player had the same roster:
    then the critic's input fits. A critic that sees all teams needs equal rosters of all teams, and one that judges for
    all teams needs the same roster for each of them. A critic that sees the whole state starts from scratch, because
    another arena has another state. Where networks encode `entities`, observations may have other sizes: if they differ
    in more than numbers of entities, `start` says so. Raises IncompatiblePolicy, one line with both sizes.
    """
    taken: Counter[tuple[Source, ...]] = Counter()  # how many agents have one of these sources already
    found = {}
    for player in players:
        side, leagues = roster_side(player.roster), (own or {}).get(player.name, before)
        actors = tuple(_source(agent, side, leagues, taken, entities) for agent in roster_agents(player.roster))
        critic = _critic(player, actors, leagues)
        if critic and not _fits(critic_input, player, players, *_of(leagues, critic)):
            critic = None
        found[player.name] = WarmStart(actors, critic)
    return found


def _source(
    agent: str, side: str, before: Sequence[Sequence[Player]], taken: Counter[tuple[Source, ...]], entities: bool
) -> Source | None:
    kind = _kind(agent)
    for sides in ({side, ""}, None):
        for league in before:
            able = {
                Source(player.league, player.name, i): other
                for player in sorted(league, key=lambda p: (p.role != "main", p.team, p.name))
                for i, other in enumerate(roster_agents(player.roster))
                if _kind(other) == kind and (not side or sides is None or roster_side(player.roster) in sides)
            }
            if able:
                known = tuple(able)
                source = known[taken[known] % len(known)]
                taken[known] += 1
                _require_sizes(agent, able[source], source, entities)
                return source
    return None


def _require_sizes(agent: str, other: str, source: Source, entities: bool) -> None:
    if other != agent and not (entities and _acts(other) == _acts(agent)):
        raise IncompatiblePolicy(
            f"{_kind(agent)} {_sizes(agent)} here, and {_sizes(other)} in {source.league}: give both the same"
            " observation (arena.buffer, say, in each stage), encode what differs in number as sets"
            " (learner.architecture.entities), or its players no forerunner"
        )


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
    older = {owner: found for owner in owners if store and (found := _best(store, *owner))}

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
        for line in arena_transfer.changed_actions(_settings_of(store, league), here, list(found))
    ]


def _settings_of(store: Store, name: str) -> str:
    """Return the settings, as TOML, with which a league, a snapshot's league or a frozen policy learnt."""
    if _is_policy(name) and name not in {league.name for league in store.leagues()}:
        return str(policy_file.read(policy_file.find(name)).about["settings"])
    return store.league(name.partition("/")[0]).config


def forerunners(store: Store | None, named: Sequence[str]) -> list[Sequence[Player]]:
    """Return the players for each name: of a league of the store, of a snapshot, of a policy that comes with the
    league, or of a file.

    Raises UnknownName for a name that is none of them, StorageError for a snapshot without networks, ExchangeError for
    a file without a policy.
    """
    leagues = {league.name: store for league in store.leagues()} if store else {}
    for name in named:
        if name.partition("/")[0] not in leagues and not _is_policy(name):
            raise UnknownName("league or trained policy", name, [*leagues, *policy_file.trained()])
    found: list[Sequence[Player]] = []
    for name in named:
        league, slash, _ = name.partition("/")
        if _is_policy(name) and name not in leagues:
            found.append([_player_of(name)])
        elif slash:
            snapshot = _snapshot(leagues[league], name)
            found.append([Player(name, snapshot.name, 0, FROZEN, snapshot.roster)])
        else:
            found.append(leagues[name].players(name))
    return found


def _snapshot(store: Store, name: str) -> Snapshot:
    """Return the snapshot that is named league/snapshot. Raises UnknownName, or StorageError if it has no networks."""
    league, _, own = name.partition("/")
    known = {snapshot.name: snapshot for snapshot in store.snapshots(league)}
    if own not in known:
        raise UnknownName("snapshot", own, [*known])
    snapshot = known[own]
    if snapshot.thinned is not None:
        raise StorageError(f"{name} has been thinned: its policy is gone")
    if snapshot.script or programs.is_program(store.blobs.get(snapshot.digest)):
        raise StorageError(f"{name} is a {'script' if snapshot.script else 'program'}: no player can go on from it")
    return snapshot


def _is_policy(name: str) -> bool:
    """Return whether the name is that of a policy that comes with the league, or a file's."""
    return name in policy_file.trained() or name.endswith(POLICY_FILE)


def _player_of(name: str) -> Player:
    """Return the player of a policy that comes with the league or is in a file. Raises ExchangeError."""
    about = policy_file.read(policy_file.find(name)).about
    return Player(name, about["name"], 0, FROZEN, about["roster"])


def of(
    store: Store | None, players: Sequence[Player], after: Sequence[str], critic_input: str = "own",
    entities: bool = False, own: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, WarmStart]:  # fmt: skip
    """Return the sources of the players of a league, among the leagues and policies named in `after`.

    `store` is None for a new store. A critic with another kind of input starts from scratch. `entities` is that of
    `warm_starts`, and `own` has the names for players that have an `after` of their own. Raises UnknownName as
    `forerunners` does, IncompatiblePolicy as `warm_starts` does.
    """
    order = sorted(players, key=lambda p: (p.role != "main", p.team, p.name))
    theirs = {name: forerunners(store, names) for name, names in (own or {}).items()}
    return {
        name: each._replace(critic=None) if each.critic and _saw(store, each.critic[0]) != critic_input else each
        for name, each in warm_starts(order, forerunners(store, after), critic_input, entities, theirs).items()
    }


def of_config(store: Store | None, players: Sequence[Player], config: Config) -> dict[str, WarmStart]:
    """Return the sources of the players of a league with these settings, as `of` does."""
    learner = config.learner
    return of(store, players, config.after, learner.critic_input, bool(learner.architecture.entities), config.own_after)


def _saw(store: Store | None, league: str) -> str:
    """Return the kind of input of the critics of a league of this store."""
    assert store is not None  # a frozen policy has no critic
    learner = toml.parse(store.league(league).config, league).get("learner", {})
    return str(learner.get("critic_input", "own"))


def start(store: Store | None, learner: "HappoLearner", sources: WarmStart) -> str | None:
    """Load the weights of a player's sources into a new learner, and return the name of the first source's checkpoint.

    Inputs that were constant during the earlier training are ignored at first
    (`checkpoint.with_constant_inputs_silenced`). Raises StorageError if a player has no checkpoint yet, or one that is
    damaged or of another network.
    """
    owners = dict.fromkeys((s.league, s.player) for s in sources.actors if s)
    kept = {owner: _state(store, *owner) for owner in owners}
    actors = [(kept[source[:2]][1], source.agent) if source else None for source in sources.actors]
    try:
        learner.warm_start(actors, kept[sources.critic][1] if sources.critic else None, from_other_arena=True)
    except ValueError as error:
        raise StorageError(f"cannot go on from {' and '.join(f'{a} {b}' for a, b in owners)}: {error}") from None
    return next((name for name, _ in kept.values()), None)


def _state(store: Store | None, league: str, player: str) -> tuple[str, Mapping[str, np.ndarray]]:
    """Return the name of a source player and its learner's state; for a frozen policy only the part for actors."""
    known = {each.name for each in store.leagues()} if store is not None else set()
    if league not in known and _is_policy(league):
        return f"{Path(league).stem}/{player}", _arrays_of(policy_file.read(policy_file.find(league)))
    assert store is not None  # `forerunners` knows no league of a store that is not there
    if "/" in league:
        snapshot = _snapshot(store, league)
        state = _named(arrays.from_bytes(store.blobs.get(snapshot.digest)))
        return league, _with_counts(state, snapshot.roster, snapshot.step)
    kept = store.checkpoint(league, player)
    if kept is None:
        raise StorageError(f"player {player} of league {league} has no checkpoint to start from")
    state = strategy_of(arrays.from_bytes(store.blobs.get(kept.digest)))  # its skills are not taken over
    if found := _best(store, league, player):
        snapshot, _ = found
        return f"{league}/{snapshot.name}", {**state, **_named(arrays.from_bytes(store.blobs.get(snapshot.digest)))}
    return f"{league}/{player}@{kept.iteration}", state


def _best(store: Store, league: str, player: str) -> tuple[Snapshot, str] | None:
    """Return the snapshot to start from for a player of a league, and its score in words; None: use the newest state.

    The critic is always the newest one, because snapshots have none.
    """
    if league not in {known.name for known in store.leagues()}:
        return None
    settings = LeagueSettings(league, store.league(league).config)
    quota = settings.get("rating", "episodes_per_pair", otherwise=Rating().episodes_per_pair)
    against = settings.get("budget", "against", otherwise=[])
    found = handed_on(LeagueState.of(store, league), player, quota, against)
    return None if found is None else (found.snapshot, found.in_words)


def thaw_into(learner: "HappoLearner", frozen: bytes, known: Mapping[str, np.ndarray]) -> None:
    """Give a learner the actors of a snapshot of its own roster.

    `known` has the number of decisions behind the statistics of observations (`checkpoint.observed`). Raises ValueError
    as `HappoLearner.load` does.
    """
    policies = arrays.from_bytes(frozen)
    state = {**_named(policies), **known}
    if "sharing" in (own := learner.save()):
        state["sharing"] = own["sharing"]
    learner.warm_start([(state, i) for i in range(len(learner.actors))], None)


def _named(policies: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return a snapshot's arrays by their names in a learner's state, which has no skills."""
    learnt = {name: array for name, array in policies.items() if not name.partition("/")[2].startswith(PREFIX)}
    return {f"actor.{name.replace('/', '.', 1)}": array for name, array in learnt.items()}


def _arrays_of(policy: policy_file.Policy) -> dict[str, np.ndarray]:
    """Return a frozen policy's actors as in a learner's state."""
    return _with_counts(_named(policy.arrays), policy.about["roster"], policy.about["steps"])


def _with_counts(state: dict[str, np.ndarray], roster: str, steps: int) -> dict[str, np.ndarray]:
    """Return the actors of a frozen policy that learnt from so many decisions, with the weight of its statistics.

    If the policy normalises observations, its statistics have the weight of these decisions, so that a first batch does
    not dominate them. They weigh at least one: the first snapshot of a later stage has learnt from none, and without a
    weight its networks would not be kept as they are when the statistics move.
    """
    for i in range(len(roster_agents(roster))):
        trunk = f"actor.{i}.trunk.observation_"
        known = max(1, steps) if np.isfinite(state[f"{trunk}clip"]) else 0
        state[f"actor.{i}.observed"] = np.full_like(state[f"{trunk}mean"], known)
    return state
