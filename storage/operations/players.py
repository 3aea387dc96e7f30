"""Operations on players: their snapshots, their checkpoints and the phases in which they learn."""

from collections.abc import Collection, Sequence

import sqlalchemy as sa

from storage.database import rows
from storage.database import schema as t
from storage.errors import UnknownName
from storage.operations.base import StoreBase
from storage.records import Checkpoint, Phase, Player, Snapshot


class Players(StoreBase):
    """The part of `storage.store.Store` that concerns players."""

    def add_players(self, players: Sequence[Player]) -> None:
        """Add the new players. Raises StorageError when a player exists with another team, role, roster or group."""
        with self._db.changing(p.league for p in players) as db:
            if not rows.add_players(db, players):
                db.rollback()

    def players(self, league: str) -> list[Player]:
        """Return the league's players by team, then name."""
        c = t.players.c
        return self._db.records(Player, t.players, c.league == league, order=(c.team, c.name))

    def set_paused(self, league: str, player: str, reason: str | None) -> None:
        """Pause a player's learning for a reason, or resume it with None. Raises UnknownName.

        Its count of setbacks stays, because it tells the next turn from those that failed: a key is queued only once.
        """
        c = t.players.c
        with self._db.writing() as db:  # the player's row before the league's, as at the end of a turn
            found = db.execute(
                sa.update(t.players).where(c.league == league, c.name == player).values(paused=reason)
            ).rowcount
            rows.bump_revisions(db, [league])
            if found == 0:
                raise UnknownName("player", player, db.scalars(sa.select(c.name).where(c.league == league)))

    def add_snapshots(self, snapshots: Sequence[Snapshot]) -> None:
        """Add the new snapshots; an existing snapshot with the same bytes stays as it is.

        Raises StorageError, adding none, when a name exists with other bytes or a blob is missing.
        """
        self._require_blobs(s.digest for s in snapshots)
        with self._db.changing(s.league for s in snapshots) as db:
            if not rows.add_snapshots(db, snapshots):
                db.rollback()

    def settings_ends(self, league: str, letters: int) -> dict[str, str]:
        """Return the last `letters` characters of the settings of every snapshot, by name; they state its origin."""
        c = t.snapshots.c
        end = sa.func.substr(c.settings, sa.func.length(c.settings) - letters + 1)
        return {name: text for name, text in self._db.rows(sa.select(c.name, end).where(c.league == league))}

    def snapshots(
        self, league: str, player: str | None = None, brief: bool = False, named: Collection[str] | None = None
    ) -> list[Snapshot]:
        """Return the league's snapshots, or one player's, by (iteration, name); snapshots without a player come first.

        With `brief`, their `settings` are left empty: these repeat the same text and are most of what would be read.
        With `named`, only those of these names; names of none are left out.
        """
        c = t.snapshots.c
        mine = [c.player == player] if player is not None else []
        mine += [c.name.in_(named)] if named is not None else []
        order = (sa.case((c.player.is_(None), 0), else_=1), c.iteration, c.name)
        omit = ("settings",) if brief else ()
        return self._db.records(Snapshot, t.snapshots, c.league == league, *mine, order=order, omit=omit)

    def snapshot_names(self, league: str) -> list[str]:
        """Return the names of the league's snapshots, which an index has: much cheaper than the snapshots."""
        return [name for (name,) in self._db.rows(sa.select(t.snapshots.c.name).where(t.snapshots.c.league == league))]

    def snapshot_count(self, league: str) -> tuple[int, int]:
        """Return how many snapshots the league has, and how many of them are thinned.

        Nothing else about snapshots ever changes, so equal counts mean equal snapshots.
        """
        c = t.snapshots.c
        return tuple(self._db.rows(sa.select(sa.func.count(), sa.func.count(c.thinned)).where(c.league == league))[0])

    def checkpoint(self, league: str, player: str) -> Checkpoint | None:
        """Return the checkpoint that a player resumes from, its newest by iteration; None before the first."""
        c = t.checkpoints.c
        mine = (c.league == league, c.player == player)
        newest = self._db.records(Checkpoint, t.checkpoints, *mine, order=rows.NEWEST_CHECKPOINT, limit=1)
        return newest[0] if newest else None

    def newest_checkpoints(self, league: str) -> dict[str, Checkpoint]:
        """Return the checkpoint that each player resumes from, by name; players without one are left out."""
        each = t.checkpoints.c.player
        newest = self._db.newest(Checkpoint, t.checkpoints, league, each, rows.NEWEST_CHECKPOINT)
        return {checkpoint.player: checkpoint for checkpoint in newest}

    def checkpoints(self, league: str) -> list[Checkpoint]:
        """Return all stored checkpoints of all players, oldest first."""
        c = t.checkpoints.c
        return self._db.records(Checkpoint, t.checkpoints, c.league == league, order=[c.id])

    def phases(self, league: str) -> dict[str, Phase]:
        """Return the newest phase of each group, by the group's name."""
        newest = self._db.newest(Phase, t.phases, league, t.phases.c.group, rows.NEWEST_PHASE)
        return {phase.group: phase for phase in newest}
