"""A state that was read piece by piece, after a failover that lost the newest commits of the store."""

import sqlite3
from contextlib import closing

from league.state.league_state import LeagueState
from storage.store import Store
from tests.league.leagues import filled, finish, match


def test_what_a_failover_has_lost_is_not_remembered(tmp_path):
    with filled(tmp_path / "store") as store:
        finish(store, matches=[match("blue@4", "blue@0", 3, 1)])
        (tmp_path / "standby").mkdir()
        with (
            closing(sqlite3.connect(tmp_path / "store" / "league.db")) as primary,
            closing(sqlite3.connect(tmp_path / "standby" / "league.db")) as standby,
        ):
            primary.backup(standby)
        finish(store, matches=[match("blue@4", "blue@0", 0, 30)])
        finish(store, matches=[match("blue@4", "blue@0", 0, 40)])
        before = LeagueState.of(store, "cup")
    with Store.open(tmp_path / "standby", blobs=tmp_path / "store" / "blobs") as standby:
        finish(standby, matches=[match("blue@4", "blue@0", 7, 2)])  # takes the number of a match that was lost
        assert standby.revision("cup") < before.revision
        found, fresh = LeagueState.of(standby, "cup", before), LeagueState.of(standby, "cup")
    assert found.read == fresh.read < before.read
    assert found.ladder.ratings.elo.tolist() == fresh.ladder.ratings.elo.tolist() != before.ladder.ratings.elo.tolist()
