"""Matchups of a training turn: the worlds are divided into K equal groups, with a policy for every team in each.

In the *present* groups every team plays its present policy. Each learning player also has groups of its own, in which
opponent sampling has drawn the other teams: past snapshots, with some rules also the present player. Only the learner
itself learns from the experience of its own groups.

Learners may ask for different shares of past opponents. There are as many present groups as any of them asks for, and
each learns from the first of them, as many as it asks for itself. So each has its own share.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from agents.policy.jax_policy import PolicyStack
from arenas.arena import Arena
from league.snapshots.codec import Policy, seat, thaw
from league.state.jobs import TrainingTurn
from storage.errors import StorageError
from storage.records import Meeting, Player, Snapshot
from storage.store import Store


class Matchups:
    """Groups of worlds of a turn. `worlds` is the requested number, rounded down to whole groups.

    `assigned[group][team]` is the name of a player, or of a snapshot in `past`. `learns_from` has the number of present
    groups, counted from the first, from which a player learns; players that are not in it learn from all of these.
    """

    def __init__(
        self, turn: TrainingTurn, present: int, worlds: int, store: Store, league: str, arena: Arena,
        learns_from: Mapping[str, int] | None = None,
    ):  # fmt: skip
        self.arena, self.turn, self._present, self._learns_from = arena, turn, present, learns_from or {}
        self.assigned: list[tuple[str, ...]] = [turn.present] * present
        self._owner: list[str | None] = [None] * present
        for learner in turn.learners:
            for past in turn.past.get(learner, ()):
                self._owner.append(learner)
                self.assigned.append(tuple(name or own for name, own in zip(past, turn.present, strict=True)))
        self.groups = len(self.assigned)
        if not self.groups or any("" in seats for seats in self.assigned):
            raise StorageError(
                f"group {turn.group} has nobody to play against in some team: give every team a player in the group,"
                " or let another group freeze its first snapshots before"
            )
        self._each = max(1, worlds // self.groups)
        self.worlds = self._each * self.groups
        past_names = {name for seats in self.assigned for name in seats} - set(turn.present)
        snapshots = {s.name: s for s in store.snapshots(league, brief=True, named=past_names)}
        self.past = {name: _known(snapshots, name) for name in past_names}
        self._past: dict[str, list[Policy]] = {name: thaw(store, past, arena) for name, past in self.past.items()}

    def stacks(
        self, now: Mapping[str, Sequence[Policy]], also: Mapping[str, Sequence[Policy]], groups: int | None = None
    ) -> dict[str, PolicyStack]:
        """Return stacked policies by agent name, for the first `groups` of worlds (None: all).

        `now` are the present players' actors, `also` as for `seat`.
        """
        everyone: dict[str, Sequence[Policy]] = {**self._past, **now}
        seats = [[everyone[seats[team]] for seats in self.assigned[:groups]] for team in range(len(self.arena.teams))]
        return seat(self.arena.teams, seats, also)

    def worlds_of(self, learner: str) -> slice | np.ndarray:
        """Return the worlds from which a player learns; none if it rests and all groups belong to other learners."""
        mine = self._groups_of(learner)
        if len(mine) == self.groups:
            return slice(None)
        return np.concatenate([np.zeros(0, int), *(np.arange(k * self._each, (k + 1) * self._each) for k in mine)])

    def teaches(self, player: str) -> bool:
        """Return whether there are worlds from which the player learns."""
        return bool(self._groups_of(player))

    def past_share(self, learner: str) -> float:
        """Return the share of the learner's worlds in which an opponent is a past snapshot."""
        assigned = [self.assigned[k] for k in self._groups_of(learner)]
        return sum(seats != self.turn.present for seats in assigned) / len(assigned)

    def opponents_of(self, learner: str, iterations: Mapping[str, int]) -> list[str]:
        """Return against whom a player learns in each of its groups of worlds, in their order, as texts.

        Equal texts mean equal policies, but for opponents that learn in this turn themselves, whose text is their name.
        `iterations` are those of the present players.
        """
        learning = self.turn.learners
        texts = {name: f"{name}@{i}" for name, i in iterations.items() if name not in learning}
        own = self.turn.present.index(learner)
        return [
            " ".join(texts.get(name, name) for team, name in enumerate(self.assigned[k]) if team != own)
            for k in self._groups_of(learner)
        ]

    def meetings(self, player: Player, iteration: int, results: np.ndarray) -> list[Meeting]:
        """Return the results of a learner's games of the turn, one row for each opponent.

        Args:
            player: the learner.
            iteration: its iteration at the end of the turn.
            results: (groups, teams, 4) its wins, draws, losses and voids against each team in each group of worlds.
        """
        sums: dict[str, np.ndarray] = {}
        for k in self._groups_of(player.name):
            for team, name in enumerate(self.assigned[k]):
                if team != player.team:
                    sums[name] = sums.get(name, 0) + results[k, team]
        drawn = self.turn.chances.get(player.name, {})
        found = []
        for name in sorted(sums):
            wins, draws, losses, voids = map(int, sums[name])
            chance, pool = drawn.get(name, (1.0, 0))
            if wins + draws + losses + voids:
                counts = (wins, draws, losses, voids)
                found.append(Meeting(player.league, player.name, iteration, name, *counts, chance, pool))
        return found

    def changed(self, before: Sequence[tuple[str, ...]]) -> np.ndarray:
        """(worlds,) Tell whether the matchup of the world's group differs from `before`, which has as many groups."""
        groups = [now != then for now, then in zip(self.assigned, before, strict=True)]
        return np.repeat(np.array(groups, bool), self._each)

    def _groups_of(self, learner: str) -> list[int]:
        """Return the groups from which a player learns."""
        shared = self._learns_from.get(learner, self._present)
        return [k for k, owner in enumerate(self._owner) if owner == learner or (owner is None and k < shared)]


def _known(snapshots: Mapping[str, Snapshot], name: str) -> Snapshot:
    if name not in snapshots:
        raise StorageError(f"the turn names a snapshot {name!r} that the league does not have")
    return snapshots[name]
