"""`league pack` and `league unpack`: what is asked of them, and what they say."""

import os
import re

import sqlalchemy as sa

from storage.store import Store
from tests.league.conftest import ROOT
from tests.league.packs import BLOB, assert_rated_alike, curriculum, ran, refused, rows


def test_a_league_that_is_there_already_stays_as_it_is(packed, tmp_path, capsys):
    where = str(tmp_path / "source")
    before = (tmp_path / "source" / "league.db").read_bytes()
    assert "There is a league 'cup' in" in refused(capsys, "unpack", str(packed), "--store", where)
    assert (tmp_path / "source" / "league.db").read_bytes() == before
    code, out, _ = ran(capsys, "unpack", str(packed), "--store", where, "--as", "bowl")
    assert code == 0
    assert "still tell the old name" in out
    with Store.open(where) as store:
        cup, bowl = rows(store), rows(store, "bowl")
        assert [row.replace("'cup'", "'bowl'") for row in cup["matches"]] == bowl["matches"]
        assert_rated_alike(store, store, "bowl")


def test_nothing_is_left_of_a_pack_that_failed(packed, tmp_path, capsys):
    (tmp_path / "source" / "blobs" / BLOB[:2] / BLOB[2:]).unlink()
    where = ("--store", str(tmp_path / "source"))
    told = refused(capsys, "pack", str(tmp_path / "b.zip"), *where)
    assert "is missing" in told
    assert "--no-recordings packs without it" in told
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cup.zip", "source"]
    assert ran(capsys, "pack", str(tmp_path / "b.zip"), *where, "--no-recordings")[0] == 0


def test_bad_asks_get_one_line(packed, tmp_path, capsys):
    where = ("--store", str(tmp_path / "source"))
    os.mkfifo(tmp_path / "pipe")
    for args, says in (
        (("pack",), "league pack needs DEST"),
        (("pack", str(packed), *where), "exists already"),
        (("pack", str(tmp_path), *where), "is a folder"),
        (("pack", str(tmp_path / "no" / "x.zip"), *where), "No such file or directory"),
        (("pack", "x.zip", *where, "--league", "cap"), "There is no league 'cap' here; there is: cup."),
        (("pack", "x.zip", *where, "--newst"), "did you mean --newest"),
        (("pack", "x.zip", "--store", str(tmp_path / "none")), "No league store"),
        (("unpack",), "league unpack needs ARCHIVE"),
        (("unpack", str(tmp_path / "none.zip")), "No such file"),
        (("unpack", str(tmp_path)), "is no file"),
        (("unpack", str(tmp_path / "pipe")), "is no file"),
        (("unpack", str(packed), "--as", "a/b"), "a name is made of letters"),
        (("unpack", str(packed), "--as", ""), "must be a name"),
        (("unpack", str(packed), "--store", "mysql://x"), "is possible"),
        (("unpack", "nul\0"), "is no name of a file"),
    ):  # fmt: skip
        assert says in refused(capsys, *args)


def test_no_password_is_printed(packed, tmp_path, capsys, server_url):
    given = sa.make_url(server_url)
    word = str(given.password or "hunter2")  # a server that trusts everybody takes any
    secret = given.set(password=word).render_as_string(hide_password=False)
    code, out, err = ran(capsys, "unpack", str(packed), "--store", secret, "--blobs", str(tmp_path / "b"))
    assert code == 0
    assert word not in out + err


def test_several_leagues_are_asked_for_by_several_flags(tmp_path, capsys):
    with curriculum(tmp_path / "source"):
        pass
    where = ("--store", str(tmp_path / "source"))
    code, out, _ = ran(capsys, "pack", str(tmp_path / "a.zip"), *where, "--league", "other", "--league=cup.walk")
    assert code == 0
    named = re.search(r"Packed leagues ([^(]*) \(", out)
    assert named
    assert sorted(named[1].split(", ")) == ["base", "cup", "cup.push", "cup.walk", "other"]
    assert "With what they need to go on: base, cup, cup.push." in out


def test_moving_loads_nothing_heavy(packed, tmp_path):
    import subprocess
    import sys

    script = (
        "import sys; from league.commands.store import archives, policies; "
        f"archives.unpack([{str(packed)!r}, '--store', {str(tmp_path / 'new')!r}]); "
        "print([m for m in ('jax', 'torch', 'mujoco', 'pandas') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "[]", done.stderr
