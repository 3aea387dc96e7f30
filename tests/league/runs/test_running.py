"""`league.run` in a script without a guard: Ctrl-C stops it cleanly, and so does the end of the script."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from league.config.experiment import Config
from league.runs.child_run import ChildRun
from league.state.liveness import leader
from tests.league.conftest import ENVIRONMENT, wait_for

SCRIPT = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
import league
settings = {"arena": {"name": "rock-paper-scissors"}, "league": "long", "training": {"worlds": 64}}
try:
    league.run(settings)
except KeyboardInterrupt:
    print("interrupted", league.open("league-data").players().now.tolist())
"""


def begin(folder: Path) -> subprocess.Popen:
    (folder / "script.py").write_text(SCRIPT)
    with (folder / "out.txt").open("w") as out:
        return subprocess.Popen(
            [sys.executable, "-u", "script.py"], cwd=folder, stdout=out, stderr=out, env=ENVIRONMENT
        )


def learnt(store) -> bool:
    return any(each.iteration > 2 for each in store.newest_checkpoints("long").values())


@pytest.mark.parametrize("milliseconds", range(0, 60, 5))  # as Python itself starts, imports `site`, and the program
def test_ctrl_c_before_it_has_begun_is_no_fault_of_the_run(milliseconds, tmp_path):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # the process inherits what is ignored
    try:
        child = ChildRun(str(tmp_path), Config())
        time.sleep(milliseconds / 1000)
        child.interrupt()
        with pytest.raises(KeyboardInterrupt):
            child.end()
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.slow
def test_ctrl_c_lets_it_finish_its_iteration(tmp_path):
    process = begin(tmp_path)
    wait_for(tmp_path, learnt)
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 0
    said = (tmp_path / "out.txt").read_text()
    assert "Stopped at iteration" in said
    assert "interrupted ['stopped', 'stopped']" in said


@pytest.mark.slow
def test_it_stops_when_the_script_is_gone(tmp_path):
    process = begin(tmp_path)
    wait_for(tmp_path, learnt)
    process.kill()
    process.wait()
    wait_for(tmp_path, lambda store: leader(store, "long") is None, 60)
