"""Bad input by class, drawn by Hypothesis: what a hostile or careless user may type, write, or do to a store's files.

A case is a command line and a change to a folder before the command runs there. The folder begins with a small league
in `store`, the same league packed in `cup.zip`, a configuration, match and payoff logs, and an exported policy.
"""

import sqlite3
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from league.commands.cli import COMMANDS
from league.config import experiment as configuration
from league.config import flags
from storage.database import schema

VALUES = (
    *("nan", "-inf", "1e308", "-1", "-0", "0", "1e999", "0x10", "９９", "½", "9" * 400, "7" * 10_000, str(2**63)),
    *(
        "",
        " ",
        "none",
        "true",
        "[]",
        "{}",
        "[[[[",
        '"',
        "'",
        "\\",
        "\x00",
        "\x1b[31m",
        "\udcff",
        "∞",
        "a" * 10_000,
        "-",
    ),
    *("../../etc/passwd", "/", "/dev/null", "/dev/full", "/proc/self/mem", "~", ".", "*", "%s%n", "${HOME}", "`id`"),
    *("main", "blue", "blue@4", "cuda", "1s", "-5m", "1e9y", "10:00", "1979-05-27", "cup", "c", "sumo-2v2", "--", "-x"),
)
BRIEF = ("stop", "thin", "sprt", "export", "pack", "worker", "arenas", "report")
SECRET = "hunter2"
READING = ("ratings", "matches", "snapshots", "curves", "payoff", "forgetting", "status", "explain", "meta", "verify")
FILES = {
    "csv": "results.csv",
    "matrix": "payoff.csv",
    "toml": "league.toml",
    "zip": "cup.zip",
    "policy": "blue.safetensors",
}


@dataclass(frozen=True)
class Case:
    """A command line, and the change to a file or a store before it."""

    args: tuple[str, ...]
    harm: Callable[[Path], None] | None = None
    detail: str = ""  # for the report of a bad answer
    encoding: str = "utf-8"  # of standard output


value = st.one_of(st.sampled_from(VALUES), st.text(max_size=12), st.floats().map(str), st.integers().map(str))


@st.composite
def damaged(draw: st.DrawFn, data: bytes) -> bytes:
    """Draw bytes that were cut, doubled, spliced with others or replaced."""
    at = draw(st.integers(0, max(0, len(data) - 1)))
    end = draw(st.integers(at, min(len(data), at + 64)))
    return draw(st.sampled_from((
        data[:at], data[at:], data[:at] + data[end:], data + data[at:], draw(st.binary(max_size=64)),
        data[:at] + draw(st.binary(max_size=16)) + data[end:],
        data[:at] + draw(value).encode(errors="surrogateescape") + data[end:],
    )))  # fmt: skip


@st.composite
def words(draw: st.DrawFn, text: str) -> bytes:
    """Draw a text in which some words or lines are changed."""
    lines = text.splitlines()
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(lines) - 1))
        cells = lines[at].replace(" = ", "\0").replace(",", "\0").split("\0")
        cells[draw(st.integers(0, len(cells) - 1))] = draw(value)
        joined = (" = " if " = " in lines[at] else ",").join(cells)
        lines[at : at + 1] = draw(st.sampled_from(([joined], [], [lines[at]] * 2, [joined, lines[at]])))
    return "\n".join(lines).encode(errors="surrogateescape")


def put(file: str, data: bytes) -> Callable[[Path], None]:
    """Return a change that overwrites a file."""
    return lambda folder: (folder / file).write_bytes(data) and None


@st.composite
def settings(draw: st.DrawFn, kept: Path) -> Case:
    """Draw a damaged file of settings."""
    text = (kept / FILES["toml"]).read_text()
    data = draw(words(text)) if draw(st.booleans()) else draw(damaged(text.encode()))
    return Case(("run", FILES["toml"], "--store", "new", "--help"), put(FILES["toml"], data), repr(data)[-300:])


@st.composite
def options(draw: st.DrawFn, kept: Path) -> Case:
    """Draw flags of any command that does not work for long; of `run` those whose values its help shows."""
    name = draw(st.sampled_from([*READING, *BRIEF, "run", "run", "run", "nonsense", *COMMANDS]))
    base = configuration.default()
    keys = [".".join(key) for key in flags.every(configuration.Config, base)]
    mine = st.sampled_from(
        ["store", "league", "format", "arena", "engine", "as-of", "age", "output", "kinds", "number"]
    )
    flag = draw(st.sampled_from(keys)) if name == "run" else draw(mine)
    text = [f"--{flag}={draw(value)}"] if draw(st.booleans()) else [f"--{flag}", draw(value)]
    more = draw(st.lists(value, max_size=2))
    args = [name, *text, *more, *(["--help"] if name not in (*READING, *BRIEF) else [])]
    return Case(tuple(arg.replace("\0", "") for arg in args))  # no command line contains a zero byte


@st.composite
def logs(draw: st.DrawFn, kept: Path) -> Case:
    """Draw damaged files of matches and payoffs."""
    command, file = draw(st.sampled_from((("rate", FILES["csv"]), ("meta", FILES["matrix"]))))
    text = (kept / file).read_text()
    data = draw(words(text)) if draw(st.booleans()) else draw(damaged(text.encode()))
    return Case((command, file), put(file, data), repr(data)[-300:])


@st.composite
def archives(draw: st.DrawFn, kept: Path) -> Case:
    """Draw damaged packed leagues and policies."""
    if draw(st.booleans()):
        data = draw(damaged((kept / FILES["zip"]).read_bytes()))
        return Case(("unpack", FILES["zip"], "--store", "new"), put(FILES["zip"], data), f"{len(data)} bytes")
    data = draw(damaged((kept / FILES["policy"]).read_bytes()))
    return Case(("import", FILES["policy"], "--as", "strange", "--store", "store"), put(FILES["policy"], data))


@st.composite
def rows(draw: st.DrawFn, kept: Path) -> Case:
    """Draw a store with impossible rows, or a database with damaged bytes, tables or schema."""
    table = draw(st.sampled_from(sorted(schema.metadata.tables)))
    column = draw(st.sampled_from([c.name for c in schema.metadata.tables[table].columns]))
    cell = draw(st.one_of(value, st.integers(-(2**63), 2**63 - 1), st.floats(), st.binary(max_size=8), st.none()))
    cell = cell.encode(errors="replace").decode() if isinstance(cell, str) else cell
    change = f'UPDATE OR IGNORE "{table}" SET "{column}" = ?'
    statement = draw(st.sampled_from((
        change, f"{change} WHERE rowid = 1",
        f'DELETE FROM "{table}"', f'DROP TABLE "{table}"', f'ALTER TABLE "{table}" RENAME COLUMN "{column}" TO gone',
    )))  # fmt: skip
    if draw(st.integers(0, 3)):
        return Case(
            draw(_reader),
            lambda folder: _execute(folder / "store/league.db", statement, cell),
            f"{statement} {cell!r}"[:300],
        )
    data = draw(damaged((kept / "store/league.db").read_bytes()))
    return Case(draw(_reader), put("store/league.db", data), f"{len(data)} bytes")


@st.composite
def blobs(draw: st.DrawFn, kept: Path) -> Case:
    """Draw a damaged blob."""
    path = draw(st.sampled_from(sorted((kept / "store/blobs").glob("*/*"))))
    data, where = draw(damaged(path.read_bytes())), str(path.relative_to(kept))
    args = draw(st.sampled_from((("verify",), ("export", "blue@4", "-o", "new.safetensors"), ("pack", "new.zip"))))
    return Case((*args, "--store", "store"), put(where, data), where)


@st.composite
def urls(draw: st.DrawFn, kept: Path) -> Case:
    """Draw unreachable locations of stores and blobs."""
    scheme = draw(st.sampled_from(("sqlite", "postgresql", "postgres", "mysql", "file", "s3", "http", "", "sqlite+x")))
    mark = draw(st.sampled_from(("://", ":///", "//", ":/", ":", ":////")))
    secret = st.sampled_from((f"bob:{SECRET}@", f"?password={SECRET}", f":{SECRET}@", f"&sslpassword={SECRET}"))
    rest = "".join(draw(st.lists(st.one_of(value, secret, st.sampled_from("@:/?#%&=")), max_size=5)))
    flag = draw(st.sampled_from(("--store", "--store", "--blobs")))
    place = f"{scheme}{mark}{rest}" if draw(st.booleans()) else draw(value)
    # Nothing listens on this port, so that a valid URL is refused at once.
    if "postgres" in place:
        place += ("&" if "?" in place else "?") + "connect_timeout=1&hostaddr=127.0.0.1&port=1"
    return Case((draw(st.sampled_from(READING)), flag, place.replace("\0", "")))


_reader = st.sampled_from([(name, "--store", "store") for name in READING if name != "explain"])

CLASSES: Mapping[str, Callable[[Path], st.SearchStrategy[Case]]] = {
    "configuration": settings, "flags": options, "match files": logs, "archives": archives, "rows": rows,
    "blobs": blobs, "URLs": urls,
}  # fmt: skip


def _execute(database: Path, statement: str, cell: Any) -> None:
    connection = sqlite3.connect(database, isolation_level=None)
    try:
        connection.execute("PRAGMA ignore_check_constraints = ON")
        connection.execute(statement, (cell,) if "?" in statement else ())
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    except (sqlite3.Error, UnicodeError):
        pass  # the database itself refuses it
    finally:
        connection.close()
