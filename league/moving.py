"""Leagues carried from store to store: `pack` writes them as one file, `unpack` adds them to a store, as they were.

A league brings along what it needs to go on: a stage its whole curriculum, and every league those leagues named in
`after`. What an archive holds is examined to its last byte before anything is written.
"""

import time
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from league.config.schema import ConfigError, Key, literal
from league.config.sections import check_name
from league.config.toml_lines import key_lines
from league.course import course, stages_of
from league.exchange import trained
from league.versions import versions
from storage import moving
from storage.archive import Archive, Writer
from storage.errors import DamagedBlob, NotAStore, StorageError, UnknownName
from storage.files import whole_file
from storage.store import Store
from storage.tables import newest_schema

Tell = Callable[[str, int, int | None], None]
"""Is told how it goes on: of what, how much, and of how much (None: that is not known)."""


@dataclass(frozen=True)
class Moved:
    """What was packed or unpacked."""

    leagues: tuple[str, ...]
    rows: Mapping[str, int]  # by table
    blobs: int
    bytes: int  # of the archive


def pack(
    store: Store,
    path: Path,
    names: Sequence[str] = (),
    newest: bool = False,
    recordings: bool = True,
    tell: Tell = lambda *_: None,
) -> Moved:
    """Write leagues, by default all of the store, as one file; what they need to go on comes along.

    Of the `newest` state there is everything but recordings and the checkpoints that nobody goes on from. The league
    may run meanwhile: all rows are as they are at one moment. They pass the same examination as when they are unpacked.

    Raises UnknownName, StorageError where nothing can be written, or rows or blobs are damaged; then no file is left.
    """
    leagues = needed(store, names or [each.name for each in store.leagues()])
    if not leagues:
        raise StorageError(f"{store.where} holds no league yet: `league run` makes one.")
    recordings = recordings and not newest
    blobs: dict[str, str] = {}  # digest -> table
    counts: dict[str, int] = {}
    check = moving.Check(leagues, ())
    with whole_file(path) as file, Writer(file) as archive:

        def watched(table: str, rows: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
            for done, row in enumerate(rows, start=1):
                tell(table, done, None)
                if moving.needs_blob(table, row):
                    digest = row[moving.BLOBS[table]]
                    blobs.setdefault(digest, table)
                    check.blobs.add(digest)
                try:
                    check.row(table, done, row)
                    if table == "leagues":
                        check_name(row["name"])
                except ValueError as error:
                    raise StorageError(f"{store.where} is damaged, and cannot be packed: {error}.") from None
                yield row

        def take(table: str, rows: Iterator[dict[str, Any]]) -> None:
            counts[table] = archive.rows(table, watched(table, rows))

        store.dump(leagues, take, newest, recordings)
        for done, (digest, table) in enumerate(blobs.items()):
            tell("blobs", done, len(blobs))
            archive.blob(digest, _read(store, digest, table))
        archive.finish({
            "schema": newest_schema(), "leagues": leagues, "newest": newest, "recordings": recordings,
            "versions": versions(), "packed": time.time(),
        })  # fmt: skip
        size = file.tell()
    return Moved(tuple(leagues), counts, len(blobs), size)


def needed(store: Store, names: Sequence[str]) -> list[str]:
    """Those leagues and all that they need to go on: whole curricula, and what is named in `after`; oldest first.

    Raises UnknownName.
    """
    there = {each.name: each.config for each in store.leagues()}
    found, left = set(), list(names)
    while left:
        name = left.pop()
        if name not in there:
            raise UnknownName("league", name, there)
        if name in found:
            continue
        found.add(name)
        if walk := course(store, name):
            left += [walk.root, *(stage for each in walk.stages if (stage := f"{walk.root}.{each}") in there)]
        with suppress(ValueError, RecursionError, TypeError):
            after = map(str, tomllib.loads(there[name]).get("after", ()))
            left += [each for each in after if each in there or each not in trained()]
    return [name for name in there if name in found]


def _read(store: Store, digest: str, table: str) -> bytes:
    try:
        return store.blobs.get(digest)
    except DamagedBlob as error:
        more = {"matches": "--no-recordings packs without it", "checkpoints": "--newest packs without old checkpoints"}
        hint = f" (one of {table}; {more[table]})" if table in more else f" (one of {table})"
        raise StorageError(f"{error}{hint}") from error


# Unpacking -----------------------------------------------------------------------------------------------------------


def unpack(
    path: Path, where: str, blobs: str | None = None, named: str | None = None, tell: Tell = lambda *_: None
) -> Moved:
    """Add the leagues of an archive to the store at `where`, made if nothing is there; all of it or nothing.

    `named` gives the league of the archive, or its curriculum, another name. Nothing is written before everything was
    examined; then blobs are put, and last all rows in one transaction.

    Raises ArchiveError, StorageError (a league of that name is there), ConfigError (`named` cannot be).
    """
    with Archive.open(path, moving.TABLES) as archive:
        leagues = _examine(archive, tell)
        names = renamed(archive, leagues, named)
        with suppress(NotAStore), Store.open(where, blobs=blobs) as store:
            _refuse(store, names.values())
        with Store.open(where, create=True, blobs=blobs) as store:
            _refuse(store, names.values())
            for done, digest in enumerate(archive.blobs):
                tell("blobs", done, len(archive.blobs))
                store.blobs.put(archive.blob(digest))
            kept = str(Path(blobs).absolute()) if blobs and "://" not in blobs else blobs
            store.restore((table, _arriving(archive, table, names, kept, tell)) for table in moving.TABLES)
        rows = {table: archive.rows[table]["rows"] for table in moving.TABLES}
        return Moved(tuple(names.values()), rows, len(archive.blobs), path.stat().st_size)


def renamed(archive: Archive, leagues: Sequence[str], named: str | None) -> dict[str, str]:
    """The names that the archive's leagues have from now on, by those they have in it. Raises ConfigError."""
    if named is None:
        return {name: name for name in leagues}
    check_name(named)
    root = leagues[0]
    family = {root, *(f"{root}.{stage}" for stage in stages_of(_configs(archive)[root]))}
    if others := [name for name in leagues if name not in family]:
        raise ConfigError(
            ("as",),
            f"--as renames one league, or one curriculum with its stages; here are {root} and {', '.join(others)}:"
            " pack one of them alone, or unpack them under their own names",
        )
    return {name: named + name.removeprefix(root) for name in leagues}


def _configs(archive: Archive) -> dict[str, str]:
    return {row["name"]: row["config"] for row in archive.table("leagues")}


def _refuse(store: Store, names: Iterable[str]) -> None:
    there = {league.name for league in store.leagues()}
    moving.refuse_those([name for name in names if name in there], store.where)


def _examine(archive: Archive, tell: Tell) -> list[str]:
    """Read everything, and refuse what could not be added whole; the names of the leagues, the root first."""
    schema, leagues = archive.about.get("schema"), archive.about.get("leagues")
    if not isinstance(schema, int) or not isinstance(leagues, list) or not leagues:
        raise archive.bad("its manifest does not say which leagues it holds")
    if schema != newest_schema():
        known, packer = newest_schema(), archive.about.get("versions")
        packer = packer.get("robot-league", "?") if isinstance(packer, dict) else "?"
        how = "update robot-league" if schema > known else f"unpack it with robot-league {packer}, then open that store"
        raise archive.bad(f"its rows are of schema {schema}, and this program's of {known}: {how}")
    if missing := moving.TABLES.keys() - archive.rows.keys():
        raise archive.bad(f"it lacks the rows of {min(missing)}")
    try:
        for name in leagues:
            if not isinstance(name, str) or not name:
                raise ValueError(f"{name!r} is no name of a league")
            check_name(name)
        check = moving.Check(leagues, archive.blobs)
        for table in moving.TABLES:
            for done, row in enumerate(archive.table(table), start=1):
                tell(f"checking {table}", done, archive.rows[table]["rows"])
                check.row(table, done, row)
        check.end()
        configs = _configs(archive)
        for name, text in configs.items():
            try:
                tomllib.loads(text)
            except (ValueError, RecursionError):
                raise ValueError(f"the configuration of league {name!r} is not TOML") from None
    except ValueError as error:
        raise archive.bad(error) from None
    for done, digest in enumerate(archive.blobs):
        tell("checking blobs", done, len(archive.blobs))
        archive.check_blob(digest)
    return sorted(configs, key=lambda name: (not stages_of(configs[name]), list(configs).index(name)))


def _arriving(
    archive: Archive, table: str, names: Mapping[str, str], blobs: str | None, tell: Tell
) -> Iterator[dict[str, Any]]:
    """The rows of a table under the new names; a configuration says where blobs are now, if it said it before."""
    for done, row in enumerate(archive.table(table)):
        tell(table, done, archive.rows[table]["rows"])
        if table == "leagues":
            row["config"] = _config(row["config"], names, blobs)
        key = "name" if table == "leagues" else "league"
        row[key] = names[row[key]]
        if table == "snapshots" and row["parent"] is not None:  # of another league: main.walk/blue@16
            league, slash, snapshot = row["parent"].partition("/")
            row["parent"] = f"{names[league]}/{snapshot}" if slash and league in names else row["parent"]
        yield row


def _config(text: str, names: Mapping[str, str], blobs: str | None) -> str:
    """A league's settings with the names and the place of blobs that hold now; all else stays to the letter."""
    table = tomllib.loads(text)
    own, after = table.get("league"), table.get("after")
    changes: dict[Key, Any] = {}
    if isinstance(own, str) and names.get(own, own) != own:
        changes["league",] = names[own]
    if isinstance(after, list) and (new := [names.get(str(each), each) for each in after]) != after:
        changes["after",] = new
    if isinstance(table.get("storage"), dict) and table["storage"].get("blobs", blobs) != blobs:
        changes["storage", "blobs"] = "none" if blobs is None else blobs
    return with_values(text, changes) if changes else text


def with_values(text: str, changes: Mapping[Key, Any]) -> str:
    """A TOML text in which keys that it names, each on a line of its own, have other values.

    Raises StorageError where that cannot be done by changing those lines.
    """
    lines, places, wanted = text.splitlines(keepends=True), key_lines(text), tomllib.loads(text)
    for key, value in changes.items():
        inner = wanted
        for name in key[:-1]:
            inner = inner[name]
        inner[key[-1]] = value
        at = places[key] - 1
        end = lines[at][len(lines[at].rstrip("\r\n")) :]
        lines[at] = f"{lines[at].partition('=')[0].rstrip()} = {literal(value)}{end}"
    with suppress(ValueError, RecursionError):
        if tomllib.loads(changed := "".join(lines)) == wanted:
            return changed
    told = ", ".join(".".join(key) for key in changes)
    raise StorageError(f"The league's settings could not be changed in their text ({told}): unpack it without --as.")
