"""The commands of docs/first-league.md run one after the other, as they stand there, in small leagues."""

import re
import shlex
import shutil

import pytest

from tests.league.conftest import ROOT, said

BLOCKS = re.findall(r"^```bash\n(.*?)^```", (ROOT / "docs" / "first-league.md").read_text("utf-8"), re.M | re.S)
COMMANDS = [shlex.split(line, comments=True)[1:] for block in BLOCKS for line in block.splitlines()]
SERVES = {"dash", "watch", "doctor"}  # a window, a page, and what this machine lacks: tests of their own
LEARNS = {"run"}
MATCHES = {"payoff", "forgetting", "play", "gate", "exploit"}  # that need some, or play them
# Opponents and metrics of the page's arena, and those of an arena without bodies:
WORDS = {"pusher": "rock", "score,event.out": "score,reward"}
SHORTER = {"play": ("--episodes", "16"), "exploit": ("--budget", "8192", "--episodes", "16"), "gate": ("--most", "64")}


def shown(capsys, command: list[str]) -> str:
    code, out, err = said(capsys, *command)
    assert code in ((0, 1, 3) if command[0] == "gate" else (0,)), (command, err)
    assert out, command
    return out


def test_the_page_has_a_command_for_each_step():
    assert {"run", "ratings", "watch", "play", "gate", "init", "pack"} <= {command[0] for command in COMMANDS}


def test_what_only_reads_and_writes_files(copied_league, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    read = [command for command in COMMANDS if command[0] not in SERVES | LEARNS | MATCHES]
    assert len(read) > 6
    for command in read:
        shown(capsys, [WORDS.get(word, word) for word in command])
    assert {"league.toml", "leagues.zip", "blue.safetensors"} <= {file.name for file in tmp_path.iterdir()}


@pytest.mark.slow
def test_what_needs_matches_or_plays_them(rated_league, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")  # the commands set it for their own processes
    shutil.copytree(rated_league, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    played = [command for command in COMMANDS if command[0] in MATCHES]
    assert {command[0] for command in played} == MATCHES
    for command in played:
        kept = command[: command.index("--for")] if "--for" in command else command
        shown(capsys, [*(WORDS.get(word, word) for word in kept), *SHORTER.get(command[0], ())])
