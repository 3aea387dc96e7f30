"""Policies of your own in Python: `league.Policy` plays against a league's snapshots, or becomes one of them."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from agents.policy.host_policy import HostPolicy
from league.config.schema import ConfigError
from league.matches.adhoc_matches import Pairing
from league.snapshots.programs import callables, importing, stored
from league.snapshots.programs.kinds import kind_of
from league.state.jobs import RatingMatch
from matchmaking.ratings.scores import Score, score_interval
from storage.records import Snapshot

if TYPE_CHECKING:
    from league.queries.query import Open


class Policy:
    """A policy of one kind for each agent of a team, or one for all of them. It has not been tried yet."""

    def __init__(self, kind: str | None, sources: Sequence[Any], named: str):
        """Use one of the functions `from_...` instead. `kind` is None for callables of this process."""
        self._kind, self._sources, self._name = kind, sources, named

    @classmethod
    def from_callable(cls, *policies: Callable[..., Any]) -> Self:
        """Return the policy of callables of this process, see `league.snapshots.programs.callables`."""
        return cls(None, policies, getattr(policies[0], "__name__", type(policies[0]).__name__))

    @classmethod
    def from_onnx(cls, *paths: str) -> Self:
        """Return the policy in ONNX files."""
        return cls("onnx", paths, str(paths[0]))

    @classmethod
    def from_torchscript(cls, *paths: str) -> Self:
        """Return the policy in TorchScript files."""
        return cls("torchscript", paths, str(paths[0]))

    @classmethod
    def from_file(cls, *named: str) -> Self:
        """Return the policy that words of `league import` name: x.onnx, x.pt or x.py:function. Raises ConfigError."""
        kind = kind_of(named[0])
        if kind is None:
            raise ConfigError((), f"{named[0]} is no name of a program: give x.onnx, x.pt or x.py:function")
        return cls(kind, named, named[0])

    def add_to(self, league: "Open", name: str, team: str | None = None) -> Snapshot:
        """Add the policy to a league as a fixed player, as `league import` does.

        Raises StorageError or ConfigError, one line, also for a callable of this process: other processes have no way
        to it. Put it in a file, and name it by `from_file`.
        """
        if self._kind is None:
            raise ConfigError(
                (), f"{self._name} is a callable of this process, which a store cannot hold: put it in a file, and"
                " take Policy.from_file('file.py:name')",
            )  # fmt: skip
        program, roster = importing.read(league, self._kind, ",".join(map(str, self._sources)), team)
        return importing.bring_in(league, program, roster, name)

    def play(self, league: "Open", opponent: str | None = None, episodes: int = 128, team: str | None = None) -> Score:
        """Play a number of episodes against a snapshot of a league, and return the score; the store keeps none.

        The number is rounded up to an even one, or to a multiple of more teams. Sides are swapped if rosters allow.
        With several other teams the opponent plays each of them. In an arena of one team there is no opponent. Raises
        StorageError or ConfigError, one line, if the policy does not fit the team or cannot meet the opponent.
        """
        from league.matches.match_rows import scores_by_seed, tallied

        if not isinstance(episodes, int | np.integer) or episodes < 1:
            raise ConfigError(("episodes",), f"episodes = {episodes!r:.40}: give a whole number of 1 or more")
        teams = len({p.team for p in league.store.players(league.league)})
        if (opponent is None) != (teams == 1):
            what = (
                "one team, in which no two meet: name no opponent" if teams == 1 else f"{teams} teams: name an opponent"
            )
            raise ConfigError((), f"league {league.league} has {what}")
        roster = importing.roster_of(league, team)
        own = Snapshot(league.league, self._name, f"policy {id(self)}", roster, origin="imported")
        other, groups = None if opponent is None else league.snapshot(opponent), max(2, teams)
        found = Pairing(league, own, other, () if other is None else (other,) * (groups - 2))
        evaluator = found.evaluator(groups * -(-episodes // groups))
        evaluator.hold(own, [*self._policies(roster)])
        seats, task = (
            evaluator.side_orders(*found.players),
            RatingMatch((found.pair,), found.seed("policy"), record=False),
        )
        games = evaluator.games(league.store, seats, task.seed)
        worlds = np.arange(len(seats) * evaluator.each)
        voids = int(np.asarray(games.void)[worlds].sum())
        if other is not None:
            whose = [["own" if s is own else "other" for s in seating] for seating in seats]
            scores = scores_by_seed(games, worlds, evaluator.starts(seats), whose, worlds // evaluator.each)
            return scores.get("own", Score(float("nan"), 0.0, 1.0, 0))._replace(voids=voids)
        wins, draws, losses = tallied(games, worlds, np.zeros(len(worlds), int)).counts
        number, (low, high) = wins + draws + losses, score_interval(wins, draws, losses)
        score = (wins + draws / 2) / number if number else float("nan")
        return Score(score, float(low), float(high), number, voids)

    def _policies(self, roster: str) -> list[HostPolicy]:
        if self._kind is not None:
            return stored.host_policies(stored.read(self._kind, self._sources, roster).to_bytes(), self._name)
        agents = stored.sizes(roster)
        if len(self._sources) not in (1, len(agents)):
            raise ConfigError((), f"{len(self._sources)} callables for {len(agents)} agents: give one, or one for each")
        policies = []
        for i, agent in enumerate(agents):
            make, _ = callables.maker(self._sources[i % len(self._sources)], agent, self._name)
            policies.append(HostPolicy(make, agent.action, stored.reporter(self._name, i)))
        return policies
