"""Commands on the pages exist, with their options, and the arena of docs/own-arena.md keeps its contract."""

import re
import shlex
from dataclasses import replace
from pathlib import Path

import jax
import pytest

import arenas
from league.commands import cli
from league.config import experiment, flags
from scripts import reference_pages, site_hooks

PAGES = sorted(
    file for file in site_hooks.reachable() if file == site_hooks.HOME or re.match(r"docs/[\w-]+\.md$", file)
)
BLOCK = re.compile(r"^```(?:bash|console)?\n(.*?)^```", re.MULTILINE | re.DOTALL)
OPTION = re.compile(r"--[\w.-]+")
EVERYWHERE = {"--store", "--league", "--blobs", "--help", "--debug"}
OPEN = ("--arena.", "--learner.settings.")  # their keys depend on the arena, and on a class of one's own
OWN = re.compile(r"<!-- run: (\S+) -->\n```python\n(.*?)```", re.DOTALL)
MORE = re.compile(r"<!-- more: (\S+) -->\n```python\n(.*?)```", re.DOTALL)


def normal(option: str) -> str:
    """An option as the command line compares it."""
    return option.replace("_", "-").replace("--no-", "--")


@pytest.fixture(scope="module")
def known() -> dict[str, set[str]]:
    """Return the options that each command takes, settings included."""
    options = {
        name: EVERYWHERE | {normal(option) for option in OPTION.findall(text)}
        for name, text in reference_pages.help_pages().items()
    }
    config = experiment.default()
    options["run"] |= {normal("--" + ".".join(key)) for key in flags.every(type(config), config)}
    return options


@pytest.mark.parametrize("file", PAGES)
def test_commands_and_options_of_a_page_exist(file, known):
    wrong = []
    for block in BLOCK.findall((site_hooks.ROOT / file).read_text("utf-8")):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True) if re.match(r"league \S", line) else []
            if not words or words[1] == "COMMAND":
                continue
            given = {normal(word.partition("=")[0]) for word in words[2:] if word.startswith("--")}
            given = {option for option in given if not option.startswith(OPEN)}
            if words[1] not in known or given - known[words[1]]:
                wrong.append(line)
    assert wrong == []


def test_a_wrong_option_would_be_noticed(known):
    assert "--episodes" in known["play"]
    assert "--learner.lr" in known["run"]
    assert "--learner.lr" not in known["play"]


def test_the_arena_of_the_page_keeps_its_contract(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")  # the command sets it for its own process
    monkeypatch.chdir(tmp_path)
    ((name, code),) = OWN.findall((site_hooks.ROOT / "docs" / "own-arena.md").read_text("utf-8"))
    lines = [line for line in code.splitlines() if line.strip() and not line.startswith(("import ", "from "))]
    assert len(lines) <= 30, "the page promises thirty lines"
    Path(name).parent.mkdir()
    Path(name).write_text(code)
    with pytest.raises(SystemExit) as ended:
        cli.main(["check", f"{name}:dash"])
    out = capsys.readouterr().out
    assert (ended.value.code or 0) == 0, out
    assert out.count("ok  ") == 27


@pytest.mark.slow
def test_the_page_plays_with_other_robots_and_its_setting_reaches_the_rules(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.chdir(tmp_path)
    page = (site_hooks.ROOT / "docs" / "own-arena.md").read_text("utf-8")
    ((name, code),), ((same, more),) = OWN.findall(page), MORE.findall(page)
    assert name == same
    Path(name).parent.mkdir()
    Path(name).write_text(code + more)
    with pytest.raises(SystemExit) as ended:
        cli.main(["check", f"{name}:robot-dash", "--arena.reach", "0.5"])
    out = capsys.readouterr().out
    assert (ended.value.code or 0) == 0, out
    near, far = (replace(arenas.settings(f"{name}:robot-dash"), reach=r).build(engine="c") for r in (0.5, 2.5))
    assert near.config_hash != far.config_hash
    for arena, there in ((near, False), (far, True)):  # robots start 2 m from the middle
        state = arena.reset(jax.random.key(0))
        _, verdict = arena.judge(state.physics, state.physics, state.game)
        assert bool(verdict.events["arrival"].all()) == there
