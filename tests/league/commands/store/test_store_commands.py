"""`league verify` and `league thin` as a user types them."""

import json
import os
import shutil
import sqlite3
import time
from dataclasses import replace
from pathlib import Path

import pytest

from league.state.jobs import RatingMatch, TrainingTurn, encode
from storage.blobs.identity import store_identity
from storage.records import Checkpoint
from storage.store import Store
from tests.league.conftest import call
from tests.league.packs import ran, refused
from tests.storage import sound
from tests.storage.conftest import KEY, finish_a_job
from tests.storage.sound import DAY, blob, change, contents, older


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a sound store, in which the commands look for it when nothing is said."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROBOT_LEAGUE_BLOBS", raising=False)
    with Store.open("league-data", create=True) as store:
        sound.fill(store)
    return tmp_path / "league-data"


def stray(folder: Path) -> str:
    """A blob that nobody names, of two days ago."""
    with Store.open(folder) as store:
        digest = store.blobs.put(b"stray")
    older(blob(folder, digest))
    return digest


def test_a_sound_store_is_told_so_with_exit_code_0(folder, capsys):
    before = contents(folder)
    code, out, err = ran(capsys, "verify")
    assert (code, err) == (0, "")
    assert "27 rows and 11 blobs that they name, 2 of them recordings" in out.replace("\n", " ")
    assert "Nothing is missing, orphaned or corrupt." in out
    assert contents(folder) == before


def test_what_is_left_over_is_no_damage_and_yet_found(folder, capsys):
    stray(folder)
    code, out, err = ran(capsys, "verify")
    assert (code, err) == (1, "")
    assert "Nothing is missing or corrupt. What is orphaned takes space and does no harm" in " ".join(out.split())


def test_a_checkpoint_that_is_no_longer_kept_leaves_no_orphan(folder, capsys):
    with Store.open(folder) as store:
        trimmed = [c.digest for c in store.checkpoints("cup") if c.player == "blue"]
        state = store.blobs.put(sound.policy(77))
        finish_a_job(store, checkpoints=[Checkpoint("cup", "blue", state, 30, 3, 1.5, KEY)], keep=1)
    for digest in trimmed:
        older(blob(folder, digest))
    code, out, err = ran(capsys, "verify")
    assert (code, err) == (0, "")
    assert "2 blobs (192 bytes) of what is no longer kept" in out
    assert "Nothing is missing, orphaned or corrupt." in out
    assert json.loads(ran(capsys, "verify", "--format", "json")[1])["dropped"] == 2
    assert ran(capsys, "thin")[0] == 0
    assert not any(blob(folder, digest).exists() for digest in trimmed)
    assert "no longer kept" not in ran(capsys, "verify")[1]


def test_jobs_that_need_what_is_not_there_are_told(folder, capsys):
    turn = TrainingTurn("1", 0, ("blue",), ("blue", "red"), {"blue": "", "red": ""}, 4, {"blue": (("", "red@1"),)})
    done = replace(turn, past={"blue": (("", "red@9"),)})  # needs nothing any more
    tasks = [turn, replace(turn, learners=("gold",)), RatingMatch((("blue@1", None),), 1),
             RatingMatch((("blue@1", "red@8"),), 1)]  # fmt: skip
    with Store.open(folder) as store:
        store.queue([encode("cup", task, i) for i, task in enumerate(tasks)])
        store.queue([replace(encode("cup", turn, "odd"), payload={"group": "1"})])
        store.queue([encode("cup", done, "done", priority=9)])
        claimed = store.claim("cup", ["train"], "me:1:train", 60)
        assert claimed is not None
        store.finish(claimed[0])
    code, out, _ = ran(capsys, "verify", "--format", "json")
    found = [finding["problem"] for finding in json.loads(out)["findings"]]
    assert code == 1
    assert len(found) == 3
    for part in ("'gold', which is none of the players", "'red@8', which is none of the snapshots", "of no kind that"):
        assert any(part in problem for problem in found), found


def test_what_is_found_is_told_with_exit_code_1(folder, capsys):
    digest = stray(folder)
    with Store.open(folder) as store:
        lost = store.snapshots("cup")[1].digest
    blob(folder, lost).unlink()
    change(folder, "UPDATE matches SET wins = -1 WHERE id = 2")
    before = contents(folder)
    code, out, err = ran(capsys, "verify")
    assert (code, err) == (1, "")
    for part in ("matches cup/2", "wins is -1, below 0", "1 missing, 1 corrupt, 1 orphaned", "1 blob", "league thin"):
        assert part in out
    code, out, _ = ran(capsys, "verify", "--format", "json")
    told = json.loads(out)
    assert code == 1
    assert told["orphans_told"] is True
    assert {(f["kind"], f["place"]) for f in told["findings"]} == {
        ("missing", f"blob {lost}"), ("corrupt", "matches cup/2"), ("orphaned", f"blob {digest}"),
    }  # fmt: skip
    assert ran(capsys, "verify", "--age", "3d", "--format", "json")[1].count('"kind"') == 2
    assert contents(folder) == before


def test_hundreds_of_findings_are_a_short_table_and_all_in_json(folder, capsys):
    db = sqlite3.connect(folder / "league.db")
    columns = [row[1] for row in db.execute("PRAGMA table_info(matches)")]
    others = ", ".join(f'"{name}"' for name in columns if name not in ("id", "wins"))
    with db:
        for id in range(4, 304):
            db.execute(f"INSERT INTO matches (id, wins, {others}) SELECT {id}, -1, {others} FROM matches WHERE id = 2")
        db.execute("UPDATE leagues SET matches = 303")
    db.close()
    _, out, _ = ran(capsys, "verify")
    assert out.count("below 0") == 20
    assert "and 280 more" in out
    assert len(json.loads(ran(capsys, "verify", "--format", "json")[1])["findings"]) == 300


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("verify", "--store", "absent"), "No league store at"),
        (("verify", "--store", "postgresql//bob:secret@h/db"), "looks like a URL"),
        (("verify", "--store", "sqlite://bob:secret@h/x.db"), "give a file"),
        (("verify", "--age", "-1h"), "is not a duration"),
        (("verify", "--format", "csv"), "table"),
        (("verify", "league-data"), "what is 'league-data'?"),
        (("thin", "--store", "absent"), "No league store at"),
        (("thin", "--store", "absent", "--blobs", "elsewhere"), "No league store at"),
        (("thin", "--checkpoints", "0"), "must be at least 1"),
        (("thin", "--recordings", "-1"), "must be at least 0"),
        (("thin", "--recordings-for", "soon"), "is not a duration"),
        (("thin", "--blobs", "elsewhere"), "--alone says that none does"),
    ],
)
def test_bad_input_is_one_line_and_changes_nothing(folder, capsys, args, says):
    before = contents(folder.parent)
    told = refused(capsys, *args)
    assert says in told
    assert "secret" not in told
    assert contents(folder.parent) == before
    assert sorted(path.name for path in folder.parent.iterdir()) == ["league-data"]


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_what_is_no_database_keeps_no_command_waiting(folder, make):
    (folder / "league.db").unlink()
    make(folder / "league.db")
    for command in ("verify", "thin", "ratings"):
        done = call(command, cwd=folder.parent, timeout=60)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        assert "no file" in done.stderr or "is a folder" in done.stderr


def test_damage_is_told_under_an_ascii_locale_too(folder, monkeypatch):
    change(folder, "UPDATE matches SET b = 'Gegner Ω' || CAST(x'ff' AS TEXT) || char(27) || '[2J' WHERE id = 2")
    for variable, value in (("LC_ALL", "C"), ("PYTHONUTF8", "0"), ("PYTHONCOERCECLOCALE", "0")):
        monkeypatch.setitem(os.environ, variable, value)
    from tests.league import conftest

    monkeypatch.setattr(conftest, "ENVIRONMENT", {**conftest.ENVIRONMENT, **os.environ})
    done = call("verify", "--format", "json", cwd=folder.parent, timeout=60)
    assert (done.returncode, done.stderr) == (1, "")
    assert "\x1b" not in done.stdout
    assert json.loads(done.stdout)["findings"][0]["place"] == "matches cup/2"


def test_a_dry_run_tells_what_would_go_and_removes_nothing(folder, capsys):
    digest = stray(folder)
    before = contents(folder)
    code, out, err = ran(capsys, "thin", "--dry-run")
    assert (code, err) == (0, "")
    assert "What would go:" in out
    assert "Nothing was removed: this was a dry run." in out
    told = json.loads(ran(capsys, "thin", "--dry-run", "--format", "json")[1])
    assert [(row["what"], row["number"], row["bytes"]) for row in told["found"]] == [("blobs", 1, 5)]
    assert told["removed"] is None
    assert contents(folder) == before
    code, out, _ = ran(capsys, "thin")
    assert code == 0
    assert "Removed 5 bytes: 1 blobs and 0 files" in out.replace("\n", " ")
    assert before.keys() - contents(folder).keys() == {str(blob(folder, digest))}
    assert "there is nothing to remove" in ran(capsys, "thin")[1].replace("\n", " ")
    assert ran(capsys, "verify", "--age", "0s")[0] == 0


def test_checkpoints_stay_as_the_leagues_settings_say(folder, capsys):
    config = sound.CONFIG.replace("checkpoints = 8", "checkpoints = 1")
    for statement in (
        f"UPDATE leagues SET config = '{config}'",
        f"UPDATE checkpoints SET created = created - {2 * DAY}",
    ):
        change(folder, statement)
    assert json.loads(ran(capsys, "thin", "--format", "json")[1])["removed"]["checkpoints"] == 2
    with Store.open(folder) as store:
        assert [(c.player, c.iteration) for c in store.checkpoints("cup")] == [("blue", 2), ("red", 2)]


def test_while_a_league_runs_nothing_young_goes(folder, capsys):
    digest = stray(folder)
    with Store.open(folder) as store:
        assert store.acquire_leadership("cup", "elsewhere:1:manager", 600)
    assert "league cup runs" in refused(capsys, "thin", "--age", "10m")
    assert blob(folder, digest).is_file()
    assert ran(capsys, "thin")[0] == 0
    assert not blob(folder, digest).is_file()


def test_blobs_that_another_store_may_need_are_not_touched(folder, capsys):
    digest = stray(folder)
    with Store.open(f"sqlite:///{folder}/other.db", create=True) as store:  # its blobs are beside it, as the league's
        sound.fill(store)
        other = store_identity(store._db)
    assert "--alone says that none does" in refused(capsys, "thin")
    assert blob(folder, digest).is_file()
    shutil.copy(folder / "other.db", folder.parent / "kept.db")
    (folder / "other.db").unlink()
    assert f"its mark {other!r} is there" in refused(capsys, "thin")
    assert blob(folder, digest).is_file()
    (folder / "blobs" / str(other)).unlink()  # by hand, of a store that is no more
    assert ran(capsys, "thin")[0] == 0
    assert not blob(folder, digest).is_file()


def test_a_match_whose_recording_went_says_so_in_one_line(folder, capsys):
    change(folder, f"UPDATE matches SET created = created - {2 * DAY}")
    with Store.open(folder) as store:
        recordings = [str(match.recording) for match in store.matches("cup") if match.recording]
    for digest in recordings:
        older(blob(folder, digest))
    out = ran(capsys, "thin", "--recordings", "0")[1]
    assert "2 recordings" in out.replace("\n", " ")
    assert not [digest for digest in recordings if blob(folder, digest).exists()]
    assert "Match 1 was not recorded" in refused(capsys, "watch", "1")
    assert ran(capsys, "verify", "--age", "0s")[0] == 0


def test_blobs_among_which_another_store_has_its_mark_are_not_thinned_whatever_is_said(folder, tmp_path, capsys):
    stray(folder)
    with Store.open(tmp_path / "second", create=True, blobs=folder / "blobs") as second:
        digest = second.blobs.put(b"of the second store")
    for words in ((), ("--alone",)):
        code, out, err = ran(capsys, "thin", *words)
        assert (code, out) == (2, "")
        assert "another store keeps its blobs in" in err
        assert err.count("\n") == 1
    assert blob(folder, digest).is_file()


def test_an_orphan_of_some_hours_is_told_when_it_can_go(folder, capsys):
    with Store.open(folder) as store:
        path = blob(folder, store.blobs.put(b"young"))
    os.utime(path, times=(time.time() - 7200,) * 2)
    code, out, _ = ran(capsys, "verify")
    assert (code, "`league thin` removes it when it is a day old" in out.replace("\n", " ")) == (1, True)
    assert "there is nothing to remove that is older than 1d (--age)" in ran(capsys, "thin")[1].replace("\n", " ")
    assert "Removed 5 bytes" in ran(capsys, "thin", "--age", "1h")[1]
