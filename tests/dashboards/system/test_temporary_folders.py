"""Temporary folders of processes that are killed."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from dashboards.system.temporary_folders import temporary_folder

HOLDS = """
import signal, sys
from dashboards.system.temporary_folders import temporary_folder
for number in (signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_DFL)  # nohup has its children ignore them
with temporary_folder("robot-league-test-") as folder:
    (folder / "match.rrd").write_text("large")
    print(folder, flush=True)
    sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def holder() -> tuple[subprocess.Popen, Path]:
    process = subprocess.Popen([sys.executable, "-c", HOLDS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, Path(process.stdout.readline().strip())


def test_a_folder_ends_with_its_block(temporary):
    with pytest.raises(FileNotFoundError), temporary_folder("robot-league-test-") as folder:
        (folder / "match.rrd").rename(folder / "none" / "match.rrd")
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_who_is_asked_to_end_leaves_nothing(temporary, number):
    process, folder = holder()
    with process:
        assert folder.is_dir()
        process.send_signal(number)
        assert process.wait(30) == 128 + number
    assert list(temporary.iterdir()) == []


def test_what_a_killed_process_left_goes_with_the_next_and_what_is_in_use_stays(temporary):
    killed, left = holder()
    process, in_use = holder()
    with killed, process:
        killed.kill()
        killed.wait(30)
        assert (left / "match.rrd").is_file()
        with temporary_folder("robot-league-test-"):
            assert not left.exists()
            assert (in_use / "match.rrd").is_file()
        process.communicate(timeout=30)  # it ends with its input
    assert list(temporary.iterdir()) == []
