"""No command prints a password that stands in the place of a store or of its blobs, whatever comes of it."""

import logging
import shlex
from pathlib import Path

import pytest

from league.commands import cli, options
from storage.database.urls import display_location, without_passwords
from tests.league.leagues import filled

SECRET = "hush-hush"
WORDS = {
    "rate": ["log.csv"], "watch": ["1"], "export-match": ["1"], "gate": ["blue@1", "red@1"], "unpack": ["cup.zip"],
    "play": ["blue@1", "red@1"], "exploit": ["blue@1"], "sprt": ["1", "2", "3", "4", "5"], "pack": ["new.zip"],
    "export": ["blue@1"], "import": ["anymal-push"], "check": ["sumo-1v1"], "log": ["curves"],
    "sweep": ["sweep.toml"], "compare": ["cup"],
}  # fmt: skip
BLOBS = (
    f"s3://k:{SECRET}@b", f"s3://b/x?secret={SECRET}", f"s3:k:{SECRET}@b", f"ftp://k:{SECRET}@host/b",
    f"file://k:{SECRET}@host/b", f"s3//k:{SECRET}@b",
)  # fmt: skip
STORES = (
    f"postgresql://league:{SECRET}@127.0.0.1:1/db?connect_timeout=1", f"mysql://league:{SECRET}@127.0.0.1/db",
    f"postgresql//league:{SECRET}@127.0.0.1/db", f"postgresql://127.0.0.1:1/db?password={SECRET}",
    f"sqlite://league:{SECRET}@h/x.db",
)  # fmt: skip
TAKE_BLOBS = [
    name for name in cli.COMMANDS if name not in ("rate", "sprt", "arenas", "check", "init", "presets", "report")
]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    filled(tmp_path / "league-data").close()
    return tmp_path


def told(capfd, caplog, *args: str) -> str:
    """All that a command says, on both outputs and in its log."""
    with caplog.at_level(logging.DEBUG), pytest.raises(SystemExit):
        cli.main(list(args))
    out, err = capfd.readouterr()
    return out + err + caplog.text


def require_no_secret(folder: Path, text: str) -> None:
    assert SECRET not in text
    for path in folder.rglob("*"):
        assert not (path.is_file() and SECRET.encode() in path.read_bytes()), path


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_no_command_prints_the_password_of_a_place(name, folder, capfd, caplog):
    words = WORDS.get(name, [])
    for blobs in BLOBS:
        require_no_secret(folder, told(capfd, caplog, name, *words, "--blobs", blobs))
    for store in STORES:
        require_no_secret(folder, told(capfd, caplog, name, *words, "--store", store, f"--blobs={folder / 'b'}"))
    for odd in ([BLOBS[0], STORES[0]], ["--stroe", STORES[0]], [f"--league={STORES[0]}"], ["--format", STORES[0]]):
        require_no_secret(folder, told(capfd, caplog, name, *words, *odd))


def test_thin_names_the_place_of_blobs_without_its_password(folder, capfd, caplog):
    text = told(capfd, caplog, "thin", "--blobs", f"s3://k:{SECRET}@b")
    assert "s3://***@b" in text


def test_the_help_of_run_shows_no_password_of_a_file(folder, capfd, caplog):
    Path("l.toml").write_text(f'[storage]\nblobs = "s3://k:{SECRET}@b"\n')
    text = told(capfd, caplog, "run", "--help", "l.toml")
    assert "s3://***@b" in text
    assert SECRET not in text


def test_commands_that_are_proposed_have_no_password(folder):
    flags = options.place_flags(STORES[0], BLOBS[0], "cup")
    assert SECRET not in flags
    assert [word for word in shlex.split(flags) if word.startswith("--")] == ["--store", "--blobs", "--league"]


@pytest.mark.parametrize("place", [*BLOBS, *STORES])
def test_one_function_prints_a_place(place):
    assert SECRET not in display_location(place)
    assert SECRET not in without_passwords(f"Cannot keep anything at {place!r}: no.")


def test_a_place_without_a_scheme_is_recognised():
    assert SECRET not in without_passwords(f'--store = ":///x&sslpassword={SECRET}": has more than 10,000 characters')


@pytest.mark.parametrize("place", ["s3://bucket/prefix", "postgresql://league@host/db", "runs/a=b", "/data/blobs"])
def test_a_place_without_a_password_is_shown_whole(place):
    assert display_location(place) == place
    assert without_passwords(f"No league store at {place}: no.") == f"No league store at {place}: no."


def test_a_hidden_password_hides_no_more():
    where = display_location(f"postgresql://league:{SECRET}@a:1,b/db?sslmode=require")
    assert where == "postgresql://league:***@a:1,b/db?sslmode=require"
    assert without_passwords(f"{where}: no.") == f"{where}: no."
    assert without_passwords(f"{where}&x={SECRET}@c") != f"{where}&x={SECRET}@c"  # perhaps a part of a password


@pytest.mark.parametrize(
    "text",
    ["blue@16 against red@3 of main.walk/blue@16", "my/race.py:race", "ada:7:match0", "see s3://bucket/prefix",
     "league:blue@3", "--store=runs/blue@1"],
)  # fmt: skip
def test_text_without_a_password_stays(text):
    assert without_passwords(text) == text
