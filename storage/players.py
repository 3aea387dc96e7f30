"""The verbs about players: their snapshots, their checkpoints and the phases in which they learn."""

from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa

from storage import rows
from storage import tables as t
from storage.errors import UnknownName
from storage.records import Checkpoint, Phase, Player, Snapshot
from storage.verbs import Verbs


class Players(Verbs):
    """A part of `storage.store.Store`."""

    def add_players(self, players: Sequence[Player]) -> None:
        """Add those that are new; raises StorageError when one exists with another team, role, roster or group."""
        with self._db.changing(p.league for p in players) as db:
            if not rows.add_players(db, players):
                db.rollback()

    def players(self, league: str) -> list[Player]:
        """The league's players by team, then name."""
        c = t.players.c
        return self._db.records(Player, t.players, c.league == league, order=(c.team, c.name))

    def set_paused(self, league: str, player: str, reason: str | None) -> None:
        """Let a player learn no more, for a reason; None: let it go on, with no setbacks. Raises UnknownName."""
        c = t.players.c
        values: dict[str, Any] = {"paused": reason} if reason is not None else {"paused": None, "setbacks": 0}
        with self._db.changing([league]) as db:
            if (
                db.execute(sa.update(t.players).where(c.league == league, c.name == player).values(values)).rowcount
                == 0
            ):
                raise UnknownName("player", player, db.scalars(sa.select(c.name).where(c.league == league)))

    def add_snapshots(self, snapshots: Sequence[Snapshot]) -> None:
        """Add those that are new; one whose name is there with the same bytes stays as it is.

        Raises StorageError, adding none, when a name is there with other bytes or a blob is not there.
        """
        self._require_blobs(s.digest for s in snapshots)
        with self._db.changing(s.league for s in snapshots) as db:
            if not rows.add_snapshots(db, snapshots):
                db.rollback()

    def snapshots(self, league: str, player: str | None = None) -> list[Snapshot]:
        """The league's snapshots, or one player's, by (iteration, name); those that belong to no player come first."""
        c = t.snapshots.c
        mine = [c.player == player] if player is not None else []
        order = (sa.case((c.player.is_(None), 0), else_=1), c.iteration, c.name)
        return self._db.records(Snapshot, t.snapshots, c.league == league, *mine, order=order)

    def snapshot_count(self, league: str) -> tuple[int, int]:
        """How many snapshots the league has, and how many of them are thinned.

        Nothing else of them ever changes, so with as many as before they are the same.
        """
        c = t.snapshots.c
        return tuple(self._db.rows(sa.select(sa.func.count(), sa.func.count(c.thinned)).where(c.league == league))[0])

    def checkpoint(self, league: str, player: str) -> Checkpoint | None:
        """Where a player goes on: its newest checkpoint by iteration, None before the first."""
        c = t.checkpoints.c
        mine = (c.league == league, c.player == player)
        newest = self._db.records(Checkpoint, t.checkpoints, *mine, order=rows.NEWEST_CHECKPOINT, limit=1)
        return newest[0] if newest else None

    def newest_checkpoints(self, league: str) -> dict[str, Checkpoint]:
        """Where each player of the league goes on, by its name; those without a checkpoint are left out."""
        each = t.checkpoints.c.player
        newest = self._db.newest(Checkpoint, t.checkpoints, league, each, rows.NEWEST_CHECKPOINT)
        return {checkpoint.player: checkpoint for checkpoint in newest}

    def checkpoints(self, league: str) -> list[Checkpoint]:
        """All checkpoints kept of all players, oldest first."""
        c = t.checkpoints.c
        return self._db.records(Checkpoint, t.checkpoints, c.league == league, order=[c.id])

    def phases(self, league: str) -> dict[str, Phase]:
        """The newest phase of each group, by the group's name."""
        newest = self._db.newest(Phase, t.phases, league, t.phases.c.group, rows.NEWEST_PHASE)
        return {phase.group: phase for phase in newest}
