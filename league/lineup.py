"""Who plays whom in a training turn: worlds in K equal groups, a policy for every team in each.

In the *present* groups every team plays as it is now. Each learning player also has groups of its own, in which the
other teams are past snapshots; only its own experience from there teaches anybody.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents.policy import Params
from arenas.arena import Arena
from league.policies import seat, thaw
from matchmaking.opponents import Opponents
from storage.records import Player
from storage.store import Store


@dataclass(frozen=True)
class Turn:
    """What a training job says: iterations `first` to `last`, the teams that learn, and whose past they meet.

    `past` holds, for each learning player, one entry per group of worlds: other player -> digest of its snapshot.
    """

    first: int
    last: int
    learners: tuple[int, ...]
    past: Mapping[str, Sequence[Mapping[str, str]]]

    @classmethod
    def of(cls, payload: Mapping[str, Any]) -> "Turn":
        """The turn in a job's payload."""
        return cls(payload["first"], payload["last"], tuple(payload["learners"]), payload["past"])


class Lineup:
    """The groups of a turn. `worlds` is the number asked for, rounded down to whole groups."""

    def __init__(
        self, turn: Turn, opponents: Opponents, worlds: int, players: Sequence[Player], store: Store, arena: Arena
    ):
        self.arena = arena
        own = {player.team: turn.past.get(player.name, ()) for player in players}
        drawn = max((len(groups) for groups in own.values()), default=0)
        self.present = present_groups(opponents, drawn)
        snapshots = {s.digest: s for s in store.snapshots(players[0].league)} if drawn else {}
        # seats[team][group]: None for the player as it is now, else the past policies of its roster
        self._seats: dict[int, list[list[Params] | None]] = {p.team: [None] * self.present for p in players}
        self._owner: list[int | None] = [None] * self.present
        for team in turn.learners:
            for group in own[team]:
                self._owner.append(team)
                for player in players:
                    past = group.get(player.name)
                    self._seats[player.team].append(thaw(store, snapshots[past], arena) if past else None)
        self.groups = len(self._owner)
        self._each = max(1, worlds // self.groups)
        self.worlds = self._each * self.groups

    def policies(self, now: Sequence[list[Params]]) -> dict[str, Params]:
        """Stacked policies by agent name; `now[team]` are the players' present ones."""
        seats = [[past or now[team] for past in self._seats[team]] for team in range(len(now))]
        return seat(self.arena.teams, seats)

    def worlds_of(self, team: int) -> slice | np.ndarray:
        """The worlds from which a learning team learns."""
        mine = [k for k, owner in enumerate(self._owner) if owner in (None, team)]
        if len(mine) == self.groups:
            return slice(None)
        return np.concatenate([np.arange(k * self._each, (k + 1) * self._each) for k in mine])


def present_groups(opponents: Opponents, drawn: int) -> int:
    """Groups against present opponents beside `drawn` against past ones, so that the latter are a share `past`."""
    if drawn == 0:
        return 1
    return round(drawn * (1 - opponents.past) / opponents.past)
