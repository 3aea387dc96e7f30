"""Who plays whom in a training turn: worlds in K equal groups, a policy for every team in each.

In the *present* groups every team plays as it is now. Each learning player also has groups of its own, in which the
other teams are whom its rule has drawn: past snapshots, by some rules also the present player; only its own experience
from there teaches anybody.
"""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from agents.policy import Crew, Params
from arenas.arena import Arena
from league.jobs import TrainingTurn
from league.policies import Policy, seat, thaw
from storage.errors import StorageError
from storage.records import Meeting, Player, Snapshot
from storage.store import Store


class Lineup:
    """The groups of a turn. `worlds` is the number asked for, rounded down to whole groups.

    `seated` says who sits where, `seated[group][team]`: a player's name, or that of a snapshot in `past`. Who is
    `aloof` learns from its own groups alone.
    """

    def __init__(
        self, turn: TrainingTurn, present: int, worlds: int, store: Store, league: str, arena: Arena,
        aloof: Collection[str] = (),
    ):  # fmt: skip
        self.arena, self.turn, self._aloof = arena, turn, aloof
        self.seated: list[tuple[str, ...]] = [turn.present] * present
        self._owner: list[str | None] = [None] * present
        for learner in turn.learners:
            for past in turn.past.get(learner, ()):
                self._owner.append(learner)
                self.seated.append(tuple(name or own for name, own in zip(past, turn.present, strict=True)))
        self.groups = len(self.seated)
        if not self.groups or any("" in seats for seats in self.seated):
            raise StorageError(
                f"group {turn.group} has nobody to play against in some team: give every team a player in the group,"
                " or let another group freeze its first snapshots before"
            )
        self._each = max(1, worlds // self.groups)
        self.worlds = self._each * self.groups
        past_names = {name for seats in self.seated for name in seats} - set(turn.present)
        snapshots = {s.name: s for s in store.snapshots(league)} if past_names else {}
        self.past = {name: _known(snapshots, name) for name in past_names}
        self._past: dict[str, list[Policy]] = {name: thaw(store, past, arena) for name, past in self.past.items()}

    def crews(
        self, now: Mapping[str, Sequence[Params]], also: Mapping[str, Sequence[Params]], groups: int | None = None
    ) -> dict[str, Crew]:
        """Stacked policies by agent name; `now` are the present players' actors, `also` as for `seat`.

        Those of the first `groups` of worlds; None: of all.
        """
        everyone: dict[str, Sequence[Policy]] = {**self._past, **now}
        seats = [[everyone[seats[team]] for seats in self.seated[:groups]] for team in range(len(self.arena.teams))]
        return seat(self.arena.teams, seats, also)

    def worlds_of(self, learner: str) -> slice | np.ndarray:
        """The worlds from which a player learns; none where it rests and all are drawn for others."""
        mine = self._groups_of(learner)
        if len(mine) == self.groups:
            return slice(None)
        return np.concatenate([np.zeros(0, int), *(np.arange(k * self._each, (k + 1) * self._each) for k in mine)])

    def teaches(self, player: str) -> bool:
        """Whether there are such worlds."""
        return bool(self._groups_of(player))

    def past_share(self, learner: str) -> float:
        """The share of the learner's worlds in which an opponent is a past snapshot."""
        seated = [self.seated[k] for k in self._groups_of(learner)]
        return sum(seats != self.turn.present for seats in seated) / len(seated)

    def meetings(self, player: Player, iteration: int, results: np.ndarray) -> list[Meeting]:
        """A learner's games of the turn, opponent by opponent.

        Args:
            player: the learner.
            iteration: where it stands when the turn ends.
            results: (groups, 4) its wins, draws, losses and voids in each group of worlds.
        """
        sums: dict[str, np.ndarray] = {}
        for k in self._groups_of(player.name):
            for team, name in enumerate(self.seated[k]):
                if team != player.team:
                    sums[name] = sums.get(name, 0) + results[k]
        drawn = self.turn.odds.get(player.name, {})
        found = []
        for name in sorted(sums):
            wins, draws, losses, voids = map(int, sums[name])
            chance, pool = drawn.get(name, (1.0, 0))
            if wins + draws + losses + voids:
                counts = (wins, draws, losses, voids)
                found.append(Meeting(player.league, player.name, iteration, name, *counts, chance, pool))
        return found

    def changed(self, before: Sequence[tuple[str, ...]]) -> np.ndarray:
        """(worlds,) Where somebody else sits than in another lineup of as many groups."""
        groups = [now != then for now, then in zip(self.seated, before, strict=True)]
        return np.repeat(np.array(groups, bool), self._each)

    def _groups_of(self, learner: str) -> list[int]:
        """The groups from which a player learns."""
        shared = learner not in self._aloof
        return [k for k, owner in enumerate(self._owner) if owner == learner or (owner is None and shared)]


def _known(snapshots: Mapping[str, Snapshot], name: str) -> Snapshot:
    if name not in snapshots:
        raise StorageError(f"the turn names a snapshot {name!r} that the league does not have")
    return snapshots[name]
