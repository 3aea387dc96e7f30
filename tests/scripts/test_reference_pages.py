"""The pages of commands and settings say what the code says now."""

import re

import pytest

import arenas
from league.commands import cli
from league.config import experiment, flags
from scripts import reference_pages


@pytest.mark.parametrize("file", reference_pages.PAGES)
def test_a_page_is_what_the_code_says_now(file):
    text = (reference_pages.ROOT / file).read_text("utf-8")
    assert text == reference_pages.PAGES[file](), "the code has changed since: python -m scripts.reference_pages"


def test_every_command_is_on_the_page_with_every_option():
    text = reference_pages.commands()
    assert [name for name in cli.COMMANDS if not re.search(rf"^\| \*\*`league {name}[ `]", text, re.MULTILINE)] == []
    for name, page in reference_pages.help_pages().items():
        row = re.search(rf"^\| \*\*`league {name}[ `].*?(?=^\| \*\*|^$)", text, re.MULTILINE | re.DOTALL)
        assert row, name
        missing = [option for option in re.findall(r"^  (--[\w-]+)", page, re.MULTILINE) if f"`{option}" not in row[0]]
        assert missing == ["--help", "--debug"], name


def test_every_setting_is_on_a_page():
    text, config = reference_pages.configuration() + reference_pages.arena_settings(), experiment.default()
    keys = [".".join(key) for key in flags.every(type(config), config)]
    assert len(keys) > 100
    assert [key for key in keys if f"`{key}`" not in text and f"`[[{key}]]`" not in text] == []


@pytest.mark.parametrize("name", arenas.names())
def test_every_setting_of_an_arena_is_below_its_name(name):
    settings = arenas.settings(name)
    (part,) = [part for part in reference_pages.arena_settings().split("\n## ") if f"`{name}`" in part.split("\n")[0]]
    keys = [".".join(("arena", *key)) for key in flags.every(type(settings), settings)]
    assert keys
    assert [key for key in keys if f"| `{key}` |" not in part] == []


def test_a_page_does_not_depend_on_the_terminal_or_the_working_folder(tmp_path, monkeypatch):
    before = reference_pages.commands()
    monkeypatch.setenv("COLUMNS", "70")
    monkeypatch.chdir(tmp_path)
    assert reference_pages.commands() == before
