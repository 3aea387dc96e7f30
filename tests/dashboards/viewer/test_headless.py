import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dashboards.errors import ViewerError
from dashboards.viewer.headless import NO_DRIVER, headless_viewer, remove_abandoned_folders

HOLDS_A_VIEWER = """
from dashboards.viewer.headless import NO_DRIVER, headless_viewer
with headless_viewer((64, 64)) as viewer:
    print(viewer.folder, flush=True)
    input()
"""


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """A folder for temporary files of this process and those that it starts."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)  # read the variable anew
    return tmp_path


def test_a_viewer_leaves_nothing_behind(temporary, graphics):
    with headless_viewer((64, 64)) as viewer:
        assert viewer.folder.parent == temporary
        assert viewer.state().recordings == []
    assert viewer.process.poll() is not None
    assert list(temporary.iterdir()) == []


def test_a_viewer_ends_with_whoever_started_it_and_the_next_one_removes_what_it_left(temporary, graphics):
    command = [sys.executable, "-c", HOLDS_A_VIEWER]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        folder = Path(holder.stdout.readline().strip())
        with headless_viewer((64, 64)) as another:
            assert folder.exists(), "the folder of a viewer that runs was removed"
            holder.kill()
            holder.wait()
            deadline = time.monotonic() + 60
            while folder.exists() and time.monotonic() < deadline:  # until the kernel has ended the viewer
                remove_abandoned_folders()
                time.sleep(0.05)
            assert list(temporary.iterdir()) == [another.folder]
            assert another.state().recordings == []


def test_a_viewer_that_is_killed_is_told_from_one_without_a_driver(graphics):
    with headless_viewer((64, 64)) as viewer:
        viewer.process.kill()
        with pytest.raises(ViewerError, match="rerun's viewer was ended by SIGKILL"):
            viewer.state()


def test_a_viewer_that_hangs_is_given_up(monkeypatch, graphics):
    monkeypatch.setattr("dashboards.viewer.headless.PATIENCE", 1.0)

    def hang():
        with headless_viewer((64, 64)) as viewer:
            viewer.process.send_signal(signal.SIGSTOP)
            viewer.state()

    with pytest.raises(ViewerError, match="no picture within 1 s; is this machine very busy"):
        hang()


@pytest.mark.parametrize("backend", ["vulkan", "gl", "vulkan,gl"])
def test_without_a_driver_the_package_is_named_in_one_line(monkeypatch, backend):
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, "/nonexistent")
    monkeypatch.setenv("WGPU_BACKEND", backend)
    error = None
    try:
        with headless_viewer((64, 64)):
            assert backend != "vulkan", "a driver was found although there is none"  # a GPU's OpenGL would do
    except ViewerError as raised:
        error = str(raised)
    assert error in (NO_DRIVER, None)
    assert "apt-get install mesa-vulkan-drivers" in NO_DRIVER
