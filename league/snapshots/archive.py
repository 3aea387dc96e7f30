"""Transfer of leagues between stores: `pack` writes them as one file, `unpack` adds them to a store unchanged.

An archive includes all that a league needs to continue: for a stage its whole curriculum, and every league that these
leagues name in `after`. `unpack` checks an archive to its last byte before it writes anything.
"""

import time
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from league.config.schema import ConfigError, Key, literal
from league.config.sections import POLICY_FILE, check_name
from league.config.toml import key_lines
from league.snapshots.policy_file import trained
from league.state.curriculum_stage import course, stages_of
from league.system.packages.versions import versions
from storage.blobs.files import new_file
from storage.database.schema import newest_schema
from storage.errors import DamagedBlob, NotAStore, StorageError, UnknownName
from storage.maintenance import row_transfer
from storage.maintenance.archive import ArchiveReader, ArchiveWriter
from storage.maintenance.rollback import rollback_new_store
from storage.store import Store

Tell = Callable[[str, int, int | None], None]
"""Callback for progress: (name of the items, number done, total number or None if not known)."""


@dataclass(frozen=True)
class Moved:
    """Summary of a pack or an unpack."""

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
    """Write leagues, by default all of the store, as one file, with all that they need to continue.

    With `newest` the file omits recordings and the checkpoints from which no player continues. The league may run
    meanwhile: all rows are read at one moment. They pass the same checks as in `unpack`.

    Raises UnknownName, and StorageError if the file cannot be written or if rows or blobs are damaged; then no file
    remains.
    """
    leagues = needed(store, names or [each.name for each in store.leagues()])
    if not leagues:
        raise StorageError(f"{store.where} holds no league yet: `league run` makes one.")
    recordings = recordings and not newest
    blobs: dict[str, str] = {}  # digest -> table
    counts: dict[str, int] = {}
    check = row_transfer.RowChecker(leagues, ())
    with new_file(path) as file, ArchiveWriter(file) as archive:

        def watched(table: str, rows: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
            for done, row in enumerate(rows, start=1):
                tell(table, done, None)
                if row_transfer.needs_blob(table, row):
                    digest = row[row_transfer.BLOB_COLUMNS[table]]
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
    """Return these leagues and all that they need to continue: whole curricula, and leagues in `after`; oldest first.

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
        with suppress(ValueError, RecursionError):
            named = [each for _, after in _after_lists(tomllib.loads(there[name])) for each in after]
            leagues = [each if each in there else each.partition("/")[0] for each in named if not _is_file(each)]
            left += [each for each in leagues if each in there or each not in trained()]
    return [name for name in there if name in found]


def _after_lists(table: Mapping[str, Any]) -> Iterator[tuple[Key, list[str]]]:
    """Yield the key and the names of each `after` in a league's settings: its own, and those of its players."""
    players = table.get("players")
    of_players = enumerate(players) if isinstance(players, list) else ()
    for key, at in ((), table), *((("players", str(number)), each) for number, each in of_players):
        if isinstance(at, Mapping) and isinstance(after := at.get("after"), list):
            yield (*key, "after"), [str(each) for each in after]


def _is_file(name: str) -> bool:
    return name.endswith(POLICY_FILE)


def _read(store: Store, digest: str, table: str) -> bytes:
    try:
        return store.blobs.get(digest)
    except DamagedBlob as error:
        more = dict.fromkeys((each.name for each in row_transfer.MATCHES), "--no-recordings packs without it")
        more["checkpoints"] = "--newest packs without old checkpoints"
        hint = f" (one of {table}; {more[table]})" if table in more else f" (one of {table})"
        raise StorageError(f"{error}{hint}") from error


# Unpacking -----------------------------------------------------------------------------------------------------------


def unpack(
    path: Path, where: str, blobs: str | None = None, named: str | None = None, tell: Tell = lambda *_: None
) -> Moved:
    """Add all leagues of an archive to the store at `where`, or none; create the store if it does not exist.

    `named` gives the league of the archive, or its curriculum, another name. All checks come before the first write;
    then come the blobs, and last all rows in one transaction. If this fails, a store of files that was created for it
    is removed.

    Raises ArchiveError, StorageError (a league of that name exists), ConfigError (`named` is invalid).
    """
    with ArchiveReader.open(path, row_transfer.TABLES) as archive:
        leagues = _examine(archive, tell)
        names = renamed(archive, leagues, named)
        kept = str(Path(blobs).absolute()) if blobs and "://" not in blobs else blobs
        for row in archive.table("leagues"):  # raises before any write if settings cannot be changed
            _config(row["config"], names, kept)
        with suppress(NotAStore), Store.open(where, blobs=blobs) as store:
            _refuse(store, names.values())
        with rollback_new_store(where, blobs), Store.open(where, create=True, blobs=blobs) as store:
            _refuse(store, names.values())
            for done, digest in enumerate(archive.blobs):
                tell("blobs", done, len(archive.blobs))
                store.blobs.put(archive.blob(digest))
            store.restore((table, _arriving(archive, table, names, kept, tell)) for table in _tables(archive))
        rows = {table: archive.rows[table]["rows"] for table in _tables(archive)}
        return Moved(tuple(names.values()), rows, len(archive.blobs), path.stat().st_size)


def renamed(archive: ArchiveReader, leagues: Sequence[str], named: str | None) -> dict[str, str]:
    """Return the new names of the archive's leagues, by their names in the archive. Raises ConfigError."""
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


def _tables(archive: ArchiveReader) -> list[str]:
    """Return the tables that the archive has, in the order of their references."""
    return [table for table in row_transfer.TABLES if table in archive.rows]


def _configs(archive: ArchiveReader) -> dict[str, str]:
    return {row["name"]: row["config"] for row in archive.table("leagues")}


def _refuse(store: Store, names: Iterable[str]) -> None:
    there = {league.name for league in store.leagues()}
    row_transfer.refuse_existing([name for name in names if name in there], store.where)


def _examine(archive: ArchiveReader, tell: Tell) -> list[str]:
    """Check the whole archive, and return the names of the leagues, the root first. Raises ArchiveError."""
    schema, leagues = archive.manifest.get("schema"), archive.manifest.get("leagues")
    if not isinstance(schema, int) or not isinstance(leagues, list) or not leagues:
        raise archive.error("its manifest does not say which leagues it holds")
    if not row_transfer.OLDEST_PACKED_SCHEMA <= schema <= newest_schema():
        known, packer = newest_schema(), archive.manifest.get("versions")
        packer = packer.get("robot-league", "?") if isinstance(packer, dict) else "?"
        how = "update robot-league" if schema > known else f"unpack it with robot-league {packer}, then open that store"
        raise archive.error(f"its rows are of schema {schema}, and this program's of {known}: {how}")
    added = {table for table, since in row_transfer.ADDED_TABLES.items() if schema < since}
    if missing := row_transfer.TABLES.keys() - archive.rows.keys() - added:
        raise archive.error(f"it lacks the rows of {min(missing)}")
    try:
        for name in leagues:
            if not isinstance(name, str) or not name:
                raise ValueError(f"{name!r} is no name of a league")
            check_name(name)
        check = row_transfer.RowChecker(leagues, archive.blobs)
        for table in _tables(archive):
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
        raise archive.error(error) from None
    for done, digest in enumerate(archive.blobs):
        tell("checking blobs", done, len(archive.blobs))
        archive.check_blob(digest)
    return sorted(configs, key=lambda name: (not stages_of(configs[name]), list(configs).index(name)))


def _arriving(
    archive: ArchiveReader, table: str, names: Mapping[str, str], blobs: str | None, tell: Tell
) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table with new names; a configuration that has a place of blobs gets the new place."""
    for done, row in enumerate(archive.table(table)):
        tell(table, done, archive.rows[table]["rows"])
        if table == "leagues":
            row["config"] = _config(row["config"], names, blobs)
        key = "name" if table == "leagues" else "league"
        row[key] = names[row[key]]
        if table == "snapshots" and row["parent"] is not None:  # a snapshot of another league: main.walk/blue@16
            league, slash, snapshot = row["parent"].partition("/")
            row["parent"] = f"{names[league]}/{snapshot}" if slash and league in names else row["parent"]
        yield row


def _config(text: str, names: Mapping[str, str], blobs: str | None) -> str:
    """Return a league's settings with the new names and place of blobs; all other text stays the same."""
    table = tomllib.loads(text)
    own = table.get("league")
    changes: dict[Key, Any] = {}
    if isinstance(own, str) and names.get(own, own) != own:
        changes["league",] = names[own]
    for key, after in _after_lists(table):
        if (new := [each if _is_file(each) else _renamed(each, names) for each in after]) != after:
            changes[key] = new
    if isinstance(table.get("storage"), dict) and table["storage"].get("blobs", blobs) != blobs:
        changes["storage", "blobs"] = "none" if blobs is None else blobs
    return with_values(text, changes) if changes else text


def _renamed(start: str, names: Mapping[str, str]) -> str:
    """Return the new name of a league or of one of its snapshots, such as main/blue@49."""
    league, slash, snapshot = start.partition("/")
    return f"{names.get(league, league)}{slash}{snapshot}"


def with_values(text: str, changes: Mapping[Key, Any]) -> str:
    """Return a TOML text with other values for keys that it has, each on a line of its own.

    Raises StorageError if changing these lines is not enough.
    """
    lines, places = text.splitlines(keepends=True), key_lines(text)
    wanted: Any = tomllib.loads(text)
    for key, value in changes.items():
        inner = wanted
        for name in key[:-1]:
            inner = inner[int(name) if isinstance(inner, list) else name]
        inner[key[-1]] = value
        at = places[key] - 1
        end = lines[at][len(lines[at].rstrip("\r\n")) :]
        lines[at] = f"{lines[at].partition('=')[0].rstrip()} = {literal(value)}{end}"
    with suppress(ValueError, RecursionError):
        if tomllib.loads(changed := "".join(lines)) == wanted:
            return changed
    keys = ", ".join(".".join(key) for key in changes)
    raise StorageError(f"The league's settings could not be changed in their text ({keys}): unpack it without --as.")
