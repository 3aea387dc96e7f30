"""Standard output of every command: of another encoding, closed, without room, without a reader."""

import contextlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from league.commands import cli
from league.system import output_streams
from storage.store import Store
from tests.faults.fuzz import corpus
from tests.faults.hostile import FILES, READING
from tests.storage.sound import fill

NO_ROOM = (2, 75)
"""Exit codes for trouble of a disk, as `storage.errors` classes it."""
STORED = [(name, "--store", "store") for name in READING if name != "explain"]
WITHOUT = [
    ("rate", FILES["csv"]),
    ("meta", FILES["matrix"]),
    ("sprt", "1", "2", "3", "4", "5"),
    ("arenas",),
    ("--help",),
]
JSON = [(*args, "--format", "json") for args in STORED if args[0] in ("ratings", "matches", "snapshots", "payoff")]
CSV = [(*args, "--format", "csv") for args in STORED if args[0] in ("ratings", "matches", "snapshots", "payoff")]
SHORT = [*STORED, *WITHOUT, *JSON, *CSV, ("arenas", "sumo-1v1"), ("ratings", "--store", "nothing")]


@pytest.fixture(scope="module")
def kept(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("kept")
    corpus(folder)
    return folder


class Answer(NamedTuple):
    """Exit code, output and errors of a command."""

    code: int
    out: str
    err: str


def run(args: tuple[str, ...], out: io.TextIOWrapper) -> Answer:
    """Run a command on an output, which is flushed and closed as Python does at its end."""
    err = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), pytest.raises(SystemExit) as ended:
        cli.main(list(args))
    out.flush()
    written = out.buffer.getvalue() if isinstance(out.buffer, io.BytesIO) else b""
    out.close()
    assert isinstance(ended.value.code, int)
    return Answer(ended.value.code, written.decode(out.encoding), err.getvalue())


def memory(encoding: str = "utf-8") -> io.TextIOWrapper:
    return io.TextIOWrapper(io.BytesIO(), encoding)


def file(descriptor: int) -> io.TextIOWrapper:
    return io.TextIOWrapper(io.FileIO(descriptor, "w"), "utf-8")


def without_room() -> io.TextIOWrapper:
    return file(os.open("/dev/full", os.O_WRONLY))


def without_reader() -> io.TextIOWrapper:
    reading, writing = os.pipe()
    os.close(reading)
    return file(writing)


@pytest.mark.parametrize("args", [*SHORT, *((name, "--help") for name in cli.COMMANDS)], ids=" ".join)
def test_every_command_survives_every_output(args: tuple[str, ...], kept: Path, monkeypatch):
    monkeypatch.chdir(kept)
    plain = run(args, memory())
    assert plain.code in (0, 1, 2)
    for encoding in ("latin-1", "ascii"):
        other = run(args, memory(encoding))
        assert (other.code, other.err) == (plain.code, plain.err)
        assert other.out.count("\n") == plain.out.count("\n")
        if "json" in args:
            assert json.loads(other.out) == json.loads(plain.out)
    if not plain.out:
        return
    left, full = run(args, without_reader()), run(args, without_room())
    assert (left.code, left.err) == (0, plain.err)
    assert full.code in NO_ROOM
    assert full.err.startswith(plain.err)
    assert full.err.endswith("Cannot write to standard output: No space left on device; wait and try again.\n")
    assert full.err.count("\n") == plain.err.count("\n") + 1


def test_a_name_is_printed_exactly_in_json_and_without_its_escapes_elsewhere(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = ['ring,"=a\x1b[2J",b\u202e,1,0,1', 'ring,"=a\x1b[2J",c,1,1,1', "ring,c,b\u202e,0,1,1"]
    (tmp_path / "x.csv").write_text("\n".join(["arena,side_a,side_b,wins_a,draws,wins_b", *rows]), "utf-8")
    found: dict[str, str] = {}
    for format in ("table", "csv", "json"):
        code, found[format], said = run(("rate", "x.csv", "--format", format), memory())
        assert (code, said) == (0, "")
        assert all(line.isprintable() for line in found[format].split("\n"))
    assert {row["name"] for row in json.loads(found["json"])["ratings"]} == {"=a\x1b[2J", "b\u202e", "c"}
    assert "\n'=a\\u001b[2J," in found["csv"]
    assert " =a\\u001b[2J " in found["table"]


@pytest.mark.parametrize("args", [("status",), ("matches",), ("snapshots",), ("meta",), ("payoff", "--format", "csv")])
def test_names_in_a_store_of_a_stranger_are_printed_without_their_escapes(args, tmp_path: Path):
    import sqlite3

    with Store.open(tmp_path / "store", create=True) as store:
        fill(store)
    with contextlib.closing(sqlite3.connect(tmp_path / "store" / "league.db")) as rows, rows:
        rows.execute("PRAGMA foreign_keys = OFF")
        for table in ("snapshots", "players"):
            rows.execute(f"UPDATE {table} SET name = 'blue' || char(27) || '[2J' || char(8238) || name")
        for column in ("a", "b"):
            rows.execute(f"UPDATE matches SET {column} = 'blue' || char(27) || '[2J' || char(8238) || {column}")
    _, out, said = run((*args, "--store", str(tmp_path / "store")), memory())
    text = out + said
    assert "\\u001b[2J" in text
    assert all(line.isprintable() for line in text.split("\n"))


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_gets_our_own_lines_and_colours_and_no_others():
    terminal = Terminal()
    with contextlib.redirect_stdout(terminal), output_streams.installed():
        print("\r\x1b[Kiteration 3\x1b[1;94mblue\x1b[0m \x1b[8mhidden \x1b[2J \x1b]0;title\x07")
    assert terminal.getvalue() == (
        "\r\x1b[Kiteration 3\x1b[1;94mblue\x1b[0m \\u001b[8mhidden \\u001b[2J \\u001b]0;title\\u0007\n"
    )


def test_streams_are_as_they_were_after_a_command():
    before = sys.stdout, sys.stderr
    with output_streams.installed(), output_streams.installed():
        assert isinstance(sys.stdout, output_streams.Outlet)
    assert (sys.stdout, sys.stderr) == before


def test_a_pipe_that_breaks_elsewhere_is_not_taken_for_a_reader_who_left(capsys):
    def broken() -> int:
        raise BrokenPipeError(32, "Broken pipe")

    assert cli.guarded(broken) == 1
    assert "BrokenPipeError" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("shell", "code"),
    [
        ("{} arenas > /dev/full", NO_ROOM), ("{} arenas | true; exit ${{PIPESTATUS[0]}}", (0,)),
        ("{} arenas >&-", (0,)), ("{} nothing 2> /dev/full", (2,)), ("{} nothing 2>&-", (2,)),
    ],
)  # fmt: skip
def test_a_process_ends_in_order_on_outputs_of_a_shell(shell: str, code: tuple[int, ...]):
    command = shell.format(f"'{sys.executable}' -m league")
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode in code
    assert done.stderr.count("\n") <= 1
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
