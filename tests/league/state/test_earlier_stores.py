"""A store, a pack and a policy file that were written by commit 57ed746: see tests/league/data/README.md."""

import sqlite3
import zipfile
from pathlib import Path

import pytest

from league.commands.run.request import read
from league.config.schema import ConfigError
from league.queries.query import Open
from league.runtime.validation import validate
from storage.database.schema import newest_schema
from storage.maintenance.verify import verify
from storage.store import Store
from tests.league.packs import ran

DATA = Path(__file__).parents[1] / "data" / "57ed746"
# Elo as that commit printed it; every snapshot had played 352 games.
ELO = {
    "rock": 1021.897, "paper": 1016.572, "blue@1": 1016.173, "red@0": 1008.493, "red@2": 1001.788, "blue@3": 997.853,
    "red@1": 995.448, "blue@0": 991.507, "red@3": 986.097, "blue@2": 983.67, "random": 979.352, "scissors": 976.691,
}  # fmt: skip


@pytest.fixture
def earlier(tmp_path: Path) -> Path:
    """The folder of the store, as that commit left it."""
    with zipfile.ZipFile(DATA / "store.zip") as file:
        file.extractall(tmp_path / "store")
    return tmp_path / "store"


def rating(store: Store, league: str = "cup") -> dict[str, float]:
    table = Open(store, league).ratings()
    assert set(table["games"]) == {352}
    return dict(zip(table["name"], table["elo"].round(3), strict=True))


def test_an_earlier_store_opens_with_its_ratings_and_keeps_a_copy(earlier):
    with Store.open(earlier) as store:
        assert rating(store) == pytest.approx(ELO, abs=0.01)
        assert len(store.matches("cup")) == 66
        assert {player.name for player in store.players("cup")} == {"blue", "red"}
        assert all(store.blobs.get(snapshot.digest) for snapshot in store.snapshots("cup"))
        assert all(store.blobs.get(checkpoint.digest) for checkpoint in store.checkpoints("cup"))
    assert newest_schema() > 6
    assert (earlier / "league.db.schema-6").is_file()
    assert not verify(str(earlier)).findings


def test_commands_read_an_earlier_store(earlier, capsys):
    for command in ("ratings", "matches", "snapshots", "curves", "status", "explain blue", "payoff"):
        code, out, err = ran(capsys, *command.split(), "--store", str(earlier))
        assert (code, err) == (0, ""), command
        assert "blue" in out, command


def test_a_pack_of_an_earlier_version_unpacks_into_a_new_store(tmp_path, capsys):
    where = ("--store", str(tmp_path / "new"))
    code, out, err = ran(capsys, "unpack", str(DATA / "pack.zip"), *where)
    assert (code, err) == (0, ""), out
    with Store.open(tmp_path / "new") as store:
        assert rating(store) == pytest.approx(ELO, abs=0.01)
        assert [checkpoint.player for checkpoint in store.checkpoints("cup")] == ["blue", "red"]
    assert not verify(str(tmp_path / "new")).findings


def test_a_policy_of_an_earlier_version_is_imported_and_plays(earlier, capsys):
    where = ("--store", str(earlier))
    code, out, err = ran(capsys, "import", str(DATA / "policy.safetensors"), "--as", "veteran", *where)
    assert (code, err) == (0, ""), out
    code, out, err = ran(capsys, "play", "veteran", "rock", "--episodes", "8", *where)
    assert code == 0, err
    with Store.open(earlier) as store:
        snapshots = {snapshot.name: snapshot for snapshot in store.snapshots("cup")}
        assert snapshots["veteran"].origin == "imported"
        # The file has the weights of the newest blue snapshot.
        assert store.blobs.get(snapshots["veteran"].digest) == store.blobs.get(snapshots["blue@3"].digest)
        (match,) = store.matches("cup", "exhibition")
        assert (match.a, match.b) == ("veteran", "rock")
        assert match.wins + match.draws + match.losses == 8


def test_a_league_whose_learner_was_removed_opens_and_plays_and_learns_no_more(earlier, capsys):
    with sqlite3.connect(earlier / "league.db") as database:
        sac = '[learner]\nclass = "sac"\nsac = {batch = 64, replay = {start = 128}}\n'  # as at commit 7228567
        database.execute("UPDATE leagues SET config = replace(config, ?, ?)", ("[learner]\n", sac))
    database.close()
    where = ("--store", str(earlier))
    for command in ("ratings", "status", "play blue@3 rock --episodes 8"):
        code, out, err = ran(capsys, *command.split(), *where)
        assert (code, err) == (0, ""), command
        assert "blue" in out, command
    request = read([*where])
    assert request.config.learner.class_ == "sac"
    with pytest.raises(ConfigError) as refused:
        validate(request.config)
    assert "the learner sac was removed" in str(request.with_location(refused.value))
