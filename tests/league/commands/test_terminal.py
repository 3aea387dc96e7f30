"""What people see in a terminal, and scripts in a pipe."""

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios

import pytest

from storage.records import CurvePoint
from tests.league.conftest import ENVIRONMENT, call, command
from tests.league.leagues import filled, finish, match

CODES = re.compile(r"\x1b\[[\d;]*m")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("terminal")
    log = match("blue@4", "red@4", 48, 16), match("blue@4", "blue@0", 60, 4), match("blue@4", "blue@1", 40, 24)
    with filled(folder / "league-data", *log, match("blue@1", "red@0", 30, 34)) as store:
        points = [CurvePoint("cup", "blue", i, 100 * i, float(i), {"score": i / 4}) for i in range(1, 5)]
        finish(store, curves=points)
        store.set_config("cup", '[budget]\ntraining_time = "2h"\nsteps = 1600\n')
    return folder


def seen(folder, *args: str, term: str = "xterm-256color") -> str:
    """What a command writes to a terminal of 100 columns."""
    ours, its = pty.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 100, 0, 0))
    environment = {**{k: v for k, v in ENVIRONMENT.items() if k not in ("COLUMNS", "LINES")}, "TERM": term}
    with subprocess.Popen(command(*args), cwd=folder, stdout=its, stderr=its, env=environment) as process:
        os.close(its)
        parts = []
        while part := _read(ours):
            parts.append(part)
    os.close(ours)
    assert process.returncode == 0
    return b"".join(parts).decode().replace("\r\n", "\n")


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 65_536)
    except OSError:  # nobody has its other end any more
        return b""


def test_ratings_in_a_terminal_have_colours_and_each_players_course(folder):
    text = seen(folder, "ratings")
    assert "\x1b[" in text
    plain = CODES.sub("", text)
    best = next(line for line in plain.splitlines() if " blue@4 " in line)
    assert re.search(r" ▁[▁-█]█ ", best)  # from the first of its three snapshots to the best of all
    assert "course: the ratings of a player's snapshots" in plain


def test_status_in_a_terminal_shows_how_far_a_league_is(folder):
    plain = CODES.sub("", seen(folder, "status"))
    assert "group 1      " + "━" * 11 + "─" * 9 + " 55 %" in plain  # 4,000 s of 2 h; 400 of 1,600 steps are less
    assert " ▃▅▆█ " in plain


@pytest.mark.parametrize("name", ["ratings", "status"])
def test_scripts_and_dumb_terminals_get_the_same_plain_text(folder, name):
    piped = call(name, cwd=folder).stdout
    assert not CODES.search(piped)
    assert not re.search("[▁-█━]", piped)
    width = {**ENVIRONMENT, "COLUMNS": "100"}
    wide = subprocess.run(command(name), cwd=folder, capture_output=True, text=True, env=width, check=True).stdout
    assert seen(folder, name, term="dumb") == wide


def test_a_pipe_does_not_wait_for_the_library_that_draws(folder):
    program = (
        "import sys\nfrom league.commands.analyse.ratings import ratings\n"
        "from league.commands.run.status import status\n"
        "ratings([])\nstatus([])\nprint('rich' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, capture_output=True, text=True, env=ENVIRONMENT, check=True
    )
    assert done.stdout.splitlines()[-1] == "False"
