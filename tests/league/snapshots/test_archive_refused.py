"""An archive that is damaged, hostile or too large is refused in one line, and nothing of it is written."""

import contextlib
import hashlib
import io
import json
import shutil
import stat
import struct
import zipfile
from pathlib import Path

import pytest

from league.snapshots import archive
from storage.errors import StorageError
from storage.maintenance import archive as archives
from storage.maintenance.rollback import rollback_new_store
from storage.records import League
from storage.store import Store
from tests.league.packs import BLOB, refused, rows


def rebuilt(path: Path, change=None, add=(), manifest=None, honest: bool = False) -> None:
    """Write an archive anew: members changed by name (None: left out), members added, the manifest changed.

    `honest`: the manifest tells the truth of the members as they are now.
    """
    with zipfile.ZipFile(path) as old:
        infos = {info.filename: (info, old.read(info)) for info in old.infolist()}
    told = json.loads(infos.pop("manifest.json")[1])
    for name, data in (change or {}).items():
        data = data(infos[name][1]) if callable(data) else data
        infos[name] = (infos[name][0], data)
    for name, (_, data) in infos.items():
        if honest and data is not None and name.startswith("rows/"):
            digest, table = hashlib.sha256(data).hexdigest(), name[5:-6]
            told["rows"][table] = {"rows": len(data.splitlines()), "bytes": len(data), "sha256": digest}
    if manifest is not None:
        told = manifest(told) or told
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as new:
        for name, (info, data) in infos.items():
            if data is not None:
                fresh = zipfile.ZipInfo(name)
                fresh.compress_type = info.compress_type
                new.writestr(fresh, data)
        for info, data in add:
            new.writestr(info, data)
        new.writestr("manifest.json", told if isinstance(told, (str, bytes)) else json.dumps(told))
    path.write_bytes(out.getvalue())


def link(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name)
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return info


def edited(old: str, new: str, count: int = 1):
    """A change of a member's text that does happen."""

    def change(data: bytes) -> bytes:
        assert old.encode() in data
        return data.replace(old.encode(), new.encode(), count)

    return change


def manifest(change):
    return lambda path: rebuilt(path, manifest=change)


def declares(path: Path, name: str, size: int) -> None:
    """Let the directory of a zip declare another unpacked size of a member."""
    data = bytearray(path.read_bytes())
    at = data.rfind(name.encode()) - 46
    assert data[at : at + 4] == b"PK\x01\x02"
    data[at + 24 : at + 28] = struct.pack("<I", size)
    path.write_bytes(data)


HOSTILE = {
    "cut off": (lambda p: p.write_bytes(p.read_bytes()[:-40]), "it is cut off"),
    "cut in half": (lambda p: p.write_bytes(p.read_bytes()[: p.stat().st_size // 2]), "it is cut off"),
    "empty": (lambda p: p.write_bytes(b""), "no archive of leagues"),
    "text": (lambda p: p.write_text("hello" * 100), "no archive of leagues"),
    "pickle": (lambda p: p.write_bytes(b"\x80\x04\x95\x00cos\nsystem\n(S'x'\ntR."), "no archive of leagues"),
    "another zip": (lambda p: zipfile.ZipFile(p, "w").close(), "without manifest.json"),
    "absolute": (lambda p: rebuilt(p, add=[("/etc/passwd", b"x")]), "would lie outside"),
    "parent": (lambda p: rebuilt(p, add=[("blobs/../../x", b"x")]), "would lie outside"),
    "windows": (lambda p: rebuilt(p, add=[("C:\\x", b"x")]), "would lie outside"),
    "backslashes": (lambda p: rebuilt(p, add=[("blobs\\..\\x", b"x")]), "would lie outside"),
    "link": (lambda p: rebuilt(p, add=[(link("rows/matches.jsonl"), b"/etc/passwd")]), "is a link"),
    "unknown": (lambda p: rebuilt(p, add=[("readme.txt", b"x")]), "'readme.txt', which no archive of leagues has"),
    "long name": (lambda p: rebuilt(p, add=[("x" * 9000, b"x")]), "which no archive of leagues has"),
    "workers": (lambda p: rebuilt(p, add=[("rows/workers.jsonl", b"")]), "which no archive of leagues has"),
    "folder": (lambda p: rebuilt(p, add=[("blobs/", b"")]), "which no archive of leagues has"),
    "unnamed blob": (lambda p: rebuilt(p, add=[(f"blobs/{'0' * 64}", b"x")]), "its manifest does not name"),
    "missing blob": (lambda p: rebuilt(p, {f"blobs/{BLOB}": None}), "it lacks"),
    "missing rows": (lambda p: rebuilt(p, {"rows/matches.jsonl": None}), "it lacks"),
    "other bytes": (lambda p: rebuilt(p, {f"blobs/{BLOB}": b"episode 2"}), "do not hash to its name"),
    "other length": (lambda p: rebuilt(p, {f"blobs/{BLOB}": b"episode 10"}), "its manifest says 9"),
    "other rows": (lambda p: rebuilt(p, {"rows/matches.jsonl": edited('"wins":6', '"wins":7')}), "not those of its"),
    "declared bomb": (lambda p: declares(p, "manifest.json", 2**32 - 2), "declares 4,294,967,294 bytes"),
    "declared blob": (lambda p: declares(p, f"blobs/{BLOB}", 2**31 - 1), "and has 9"),
    "declared less": (lambda p: declares(p, "rows/matches.jsonl", 20), "its manifest says"),
    "newer": (manifest(lambda m: m.update(archive=7)), "has format 7, but this program knows only up to 1"),
    "no format": (manifest(lambda m: m.pop("archive") and None), "does not say which format"),
    "true format": (manifest(lambda m: m.update(archive=True)), "does not say which format"),
    "newer schema": (manifest(lambda m: m.update(schema=99)), "are of schema 99, and this"),
    "older schema": (manifest(lambda m: m.update(schema=1)), "then open that store"),
    "manifest no JSON": (manifest(lambda m: "{]"), "it is damaged"),
    "manifest a list": (manifest(lambda m: "[]"), "does not say which format"),
    "manifest deep": (manifest(lambda m: "[" * 200_000), "nested too deeply"),
    "manifest bare": (manifest(lambda m: {"archive": 1}), "does not say what it holds"),
    "sizes of text": (manifest(lambda m: m["blobs"].update({BLOB: "9"})), "is damaged"),
    "no leagues": (manifest(lambda m: m.update(leagues=[])), "which leagues it holds"),
    "other leagues": (manifest(lambda m: m.update(leagues=["cap"])), "is not one that the manifest"),
    "more leagues": (manifest(lambda m: m["leagues"].append("cap")), "no row tells of league 'cap'"),
    "league a path": (manifest(lambda m: m.update(leagues=["../x"])), "a name is made of letters"),
}  # fmt: skip
ROWS = {
    "no JSON": ("matches", edited('"wins":6', '"wins":six'), "it is damaged"),
    "a list": ("players", lambda data: b"[]\n" + data, "row 1 of players is no JSON object"),
    "not a number": ("matches", edited('"wins":6', '"wins":NaN'), "NaN is no figure"),
    "infinite": ("checkpoints", edited('"seconds":5000.125', '"seconds":1e999'), "seconds is no number"),
    "huge": ("matches", edited('"wins":6', '"wins":' + "9" * 30), "wins is no whole number of 64 bits"),
    "very huge": ("matches", edited('"wins":6', '"wins":' + "9" * 9000), "it is damaged"),
    "text for a number": ("matches", edited('"wins":6', '"wins":"6"'), "wins is no whole number"),
    "unknown column": ("players", edited('"team":0', '"team":0,"x":1'), "unknown column 'x'"),
    "missing column": ("players", edited('"team":0,', ""), "missing column 'team'"),
    "no value": ("players", edited('"team":0', '"team":null'), "team has no value"),
    "null character": ("players", edited('"role":"main"', '"role":"a\\u0000b"'), "role holds a null character"),
    "half a character": ("players", edited('"role":"main"', '"role":"\\ud800"'), "role is no text in UTF-8"),
    "of another league": ("runs", edited('"league":"cup"', '"league":"cap"'), "'cap' is not one that the manifest"),
    "of no player": ("checkpoints", edited('"player":"red"', '"player":"reb"'), "'reb' is none of the players"),
    "of no snapshot": ("matches", edited('"a":"blue@4"', '"a":"blue@5"'), "'blue@5' is none of the snapshots"),
    "of no blob": ("snapshots", edited('"digest":"', '"digest":"../../'), "is no blob of the archive"),
    "unknown word": ("snapshots", edited('"origin":"trained"', '"origin":"found"'), "is none of trained"),
    "twice": ("players", lambda data: data + data, "'blue' is there twice"),
    "numbered twice": ("matches", lambda data: data + data, "id 1 does not follow"),
    "beyond the count": ("leagues", edited('"matches":5', '"matches":3'), "id 4 is none of the 3"),
    "blob unnamed": ("matches", edited(f'"{BLOB}"', "null"), "is named by no row"),
    "settings": ("leagues", edited('"config":"[', '"config":"[[['), "is not TOML"),
    "values no object": ("curves", edited('"values":{', '"values":7,"x":{'), "unknown column 'x'"),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_archive_is_refused_in_one_line(case, packed, tmp_path, capsys):
    spoil, says = HOSTILE[case]
    with pytest.warns(UserWarning, match="Duplicate") if case == "link" else contextlib.nullcontext():
        spoil(packed)
    assert says in refused(capsys, "unpack", str(packed), "--store", str(tmp_path / "new"))
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("case", ROWS)
def test_rows_that_cannot_be_are_refused_though_their_digests_are_right(case, packed, tmp_path, capsys):
    table, spoil, says = ROWS[case]
    rebuilt(packed, {f"rows/{table}.jsonl": spoil}, honest=True)
    assert says in refused(capsys, "unpack", str(packed), "--store", str(tmp_path / "new"))
    assert not (tmp_path / "new").exists()


def test_what_is_large_is_refused_before_it_is_read(packed, tmp_path, capsys, monkeypatch):
    for name, says in (("LINE_LIMIT", "a row of leagues is longer"), ("ROWS_LIMIT", "bytes are possible|are possible")):
        with monkeypatch.context() as patch:
            patch.setattr(archives, name, 100)
            with pytest.raises(archives.ArchiveError, match=says):
                archive.unpack(packed, str(tmp_path / "new"))
            with Store.open(tmp_path / "source") as store, pytest.raises(StorageError, match="more than an archive"):
                archive.pack(store, tmp_path / "large.zip")
    with Store.open(tmp_path / "source") as store:
        store.blobs.put(b"x" * 200)
        monkeypatch.setattr(archives, "BLOB_LIMIT", 8)
        with pytest.raises(StorageError, match="more than an archive"):
            archive.pack(store, tmp_path / "large.zip")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cup.zip", "source"]


@pytest.mark.parametrize("member", ["manifest.json", "rows/leagues.jsonl", "rows/matches.jsonl"])
def test_a_small_archive_that_unpacks_to_much_is_refused_before_it_is_read(member, packed, tmp_path, monkeypatch):
    """A byte of JSON may take fifty of memory: 60 kB of such an archive took 6 GB."""
    bomb = b'{"name":[' + b"[]," * (2**23) + b"1]}\n"
    with zipfile.ZipFile(packed) as old:
        kept = {info.filename: old.read(info) for info in old.infolist()}
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as new:
        for name, data in {**kept, member: bomb}.items():
            new.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_STORED if "blobs" in name else zipfile.ZIP_DEFLATED)
    assert packed.stat().st_size < 100_000
    monkeypatch.setattr(archives.json, "loads", lambda *_, **__: pytest.fail("it was read"))
    with pytest.raises(archives.ArchiveError, match=f"'{member}' declares 25,.* are possible"):
        archive.unpack(packed, str(tmp_path / "new"))
    assert not (tmp_path / "new").exists()


def test_every_flipped_byte_is_seen_or_changes_nothing(packed, tmp_path):
    data = packed.read_bytes()
    archive.unpack(packed, str(tmp_path / "right"))
    with Store.open(tmp_path / "right") as store:
        right = rows(store)
    seen = 0
    for at in range(0, len(data), 97):
        packed.write_bytes(data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :])
        place = tmp_path / "new"
        try:
            archive.unpack(packed, str(place))
        except StorageError:
            seen += 1
            assert not place.exists()
        else:
            with Store.open(place) as store:
                assert rows(store) == right
            shutil.rmtree(place)
    assert seen > 50


@pytest.mark.parametrize("there", ["nothing", "a folder"])
@pytest.mark.parametrize("blobs", ["beside", "elsewhere", "no folder", "bucket"])
def test_a_store_that_could_not_be_filled_is_taken_back(there, blobs, packed, tmp_path, monkeypatch):
    place = tmp_path / "new" / "store"
    if there == "a folder":
        place.mkdir(parents=True)
    kept = {"beside": None, "elsewhere": str(tmp_path / "kept"), "no folder": str(packed / "blobs"), "bucket": "s3:x"}
    before = sorted(tmp_path.rglob("*"))
    if blobs in ("beside", "elsewhere"):  # the disk gets full with the last blob
        whole, puts = archives.ArchiveReader.blob, iter(range(3))
        monkeypatch.setattr(
            archives.ArchiveReader, "blob", lambda self, digest: whole(self, digest if next(puts, 9) < 2 else "0" * 64)
        )
    with pytest.raises((StorageError, KeyError)):
        archive.unpack(packed, str(place), kept[blobs])
    assert sorted(tmp_path.rglob("*")) == before


def test_a_store_in_which_somebody_has_made_a_league_meanwhile_stays(packed, tmp_path):
    with pytest.raises(StorageError, match="interrupted"), rollback_new_store(str(tmp_path / "new"), None):
        interrupted(tmp_path / "new")
    with Store.open(tmp_path / "new") as store:
        assert [league.name for league in store.leagues()] == ["another"]


def interrupted(place: Path) -> None:
    with Store.open(place, create=True) as store:
        store.create_league(League("another", ""))
    raise StorageError("interrupted")


def test_settings_that_cannot_be_renamed_are_refused_before_a_store_is_made(packed, tmp_path, capsys):
    lines = '"config":"league = \\"\\"\\"\\ncup\\"\\"\\"\\n'  # a value on two lines
    rebuilt(packed, {"rows/leagues.jsonl": edited('"config":"', lines)}, honest=True)
    told = refused(capsys, "unpack", str(packed), "--store", str(tmp_path / "new"), "--as", "other")
    assert told
    assert not (tmp_path / "new").exists()
