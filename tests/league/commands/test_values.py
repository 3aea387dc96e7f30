"""Values that nobody can mean, and places whose passwords must not be told, drawn by a generator with a fixed seed."""

import random
import re
from pathlib import Path
from typing import Literal, get_origin

import pytest

from league.commands import cli
from league.commands.run import request
from league.config import experiment as configuration
from league.config import flags
from league.config.experiment import Config
from league.config.schema import ConfigError, required
from storage.database.urls import database_url, display_url
from storage.errors import StorageError

NUMBERS = (
    *("nan", "inf", "-inf", "Infinity", "1e308", "-1e308", "1e13", "-1e13", "1e999", "0x10", "1e", "", "--", "½"),
    *("１２", "٣", "9" * 400, "9" * 10_000, f"{2**63}", f"{-(2**63) - 1}", "1,2", "none none", "True", "1 000"),
)


def numbers() -> list[tuple[str, type]]:
    """The flags that take a number, with their type."""
    base = configuration.default()
    found = []
    for key in flags.every(Config, base):
        kind = required(flags.find(key, Config, base))[0]
        if kind in (int, float) and get_origin(kind) is not Literal:
            found.append((".".join(key), kind))
    return found


def test_there_are_numbers_to_be_tried():
    names = {name for name, _ in numbers()}
    assert {"learner.entropy_coef", "learner.max_grad_norm", "training.worlds", "budget.reward"} <= names
    assert len([name for name in names if name.startswith("arena.")]) > 5


@pytest.mark.parametrize("text", NUMBERS)
def test_no_setting_takes_a_number_that_cannot_be_meant(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for flag, _ in numbers():
        with pytest.raises(ConfigError) as caught:
            request.read(["--preset", "quickstart", f"--{flag}={text}"])
        line = str(caught.value)
        assert "\n" not in line, flag
        assert len(line) < 900, flag
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["9" * 400, "1e5", "１m", "101y", "40000d", f"{10**30}s", "nan", "-5m"])
def test_no_setting_takes_a_time_that_cannot_be_meant(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for flag in (
        "--for",
        "--budget.training_time",
        "--budget.rating_time",
        "--storage.worker_retention",
        "--rating.milestones",
    ):
        with pytest.raises(ConfigError) as caught:
            request.read(["--preset", "quickstart", f"{flag}={text}"])
        assert len(str(caught.value)) < 600


@pytest.mark.parametrize(
    "args",
    [
        ("x" * 10_000,),
        ("ratings", "--" + "x" * 10_000),
        ("ratings", "x" * 10_000),
        ("ratings", "--store", "x" * 10_000),
        ("ratings", "--format", "x" * 10_000),
        ("run", "--learner.lr", "x" * 10_000),
        ("run", "--league", "/" * 10_000),
        ("run", "--preset", "x" * 10_000),
        ("ratings", "--store", "sqlite:" + "x" * 10_000),
        ("ratings", "--store", ""),
        ("ratings", "--store", " "),
        ("run", "--store", ""),
    ],
)
def test_what_is_long_or_empty_is_told_in_a_line_that_is_not(args, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        cli.main(list(args))
    out, err = capsys.readouterr()
    assert (ended.value.code, out, err.count("\n")) == (2, "", 1)
    assert len(err) < 3200
    assert list(tmp_path.iterdir()) == []


URLS = (
    "postgresql://bob:hush@host:5432/db", "postgresql+psycopg://bob:hush@host/db?sslmode=require",
    "postgresql://bob@host/db?password=hush", "sqlite://bob:hush@host/x.db", "postgres://bob:hush@host/db",
    "mysql://bob:hush@host/db?password=hush", "postgresql://bob:hush@host,other/db",
)  # fmt: skip


def mangled(url: str, rng: random.Random) -> str:
    """A URL as a clumsy person writes it: characters lost, doubled, swapped, put in, but not where a password is."""
    parts = re.split("(:hush@|password=hush)", url)
    for _ in range(rng.choice((1, 1, 2, 3))):
        i = rng.randrange(0, len(parts), 2)
        part = parts[i]
        at = rng.randrange(len(part) + 1)
        match rng.randrange(4):
            case 0:
                part = part[:at] + part[at + 1 :]
            case 1:
                part = part[:at] + rng.choice(":/@?#%&= [];+") + part[at:]
            case 2:
                part = part[:at] + part[at : at + 1] * 2 + part[at + 1 :]
            case _:
                part = part[:at] + part[at : at + 2][::-1] + part[at + 2 :]
        parts[i] = part
    return "".join(parts)


def test_of_3000_mangled_urls_none_tells_its_password_or_makes_a_folder_of_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng, refused, folders = random.Random(0), [], []
    for number in range(3000):
        url = mangled(URLS[number % len(URLS)], rng)
        try:
            found = database_url(url)
        except StorageError as error:
            refused.append(str(error))
            seen: BaseException | None = error
            while seen is not None:
                assert "hush" not in str(seen), url
                seen = seen.__cause__
            continue
        if found.get_backend_name() == "sqlite":
            folders.append(url)
        else:
            assert "hush" not in display_url(found), url
    assert len(refused) > 500
    assert not [line for line in refused if "\n" in line]
    assert folders == []
    assert list(tmp_path.iterdir()) == []
