"""`league worker --wait` as a supervisor starts and stops it, before there is a league."""

import signal
import subprocess
import sys

from tests.league.conftest import ENVIRONMENT, ROOT


def test_a_worker_that_waits_for_a_league_ends_well_when_it_is_asked_to(tmp_path):
    command = [sys.executable, "-m", "league", "worker", "--store", str(tmp_path / "none"), "--wait"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT, cwd=ROOT) as waiting:
        assert waiting.stderr is not None
        assert "No league store" in waiting.stderr.readline()
        waiting.send_signal(signal.SIGTERM)
        assert waiting.wait(30) == 0
