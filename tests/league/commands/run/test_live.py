"""`league run --live`: a viewer beside the run, which ends with it however that ends."""

import os
import signal
import socket
import subprocess
import sys
import time

import pytest

from dashboards.viewer.headless import free_port
from tests.league.leagues import filled

SHOWN = """
import sys, time
from league.commands.run.live import live_matches
from league.config.run_spec import RunSpec
with live_matches(RunSpec(sys.argv[1], None, ""), "cup", int(sys.argv[2])):
    print("begun", flush=True)
    sys.stdin.readline()
"""
LONGEST = 60  # seconds


def listens(port: int) -> bool:
    with socket.socket() as asked:
        return asked.connect_ex(("127.0.0.1", port)) == 0


def wait_until(port: int, there: bool) -> None:
    deadline = time.monotonic() + LONGEST
    while listens(port) != there:
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.fixture
def shown(tmp_path):
    filled(tmp_path / "league-data").close()
    port = free_port()
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    process = subprocess.Popen(
        [sys.executable, "-c", SHOWN, str(tmp_path / "league-data"), str(port)], env=environment,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    with process:
        wait_until(port, there=True)
        yield process, port
        process.kill()


def test_the_viewer_ends_with_the_run(shown):
    process, port = shown
    process.stdin.close()
    assert process.wait(LONGEST) == 0
    assert not listens(port)


def test_a_killed_run_leaves_no_viewer_behind(shown):
    process, port = shown
    os.kill(process.pid, signal.SIGKILL)
    wait_until(port, there=False)
