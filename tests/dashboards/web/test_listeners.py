"""Every listener is on loopback: no other machine reaches it."""

import os
import socket
import sys
import time
from pathlib import Path

import pytest

from dashboards import viewer
from dashboards.errors import ViewerError
from dashboards.system.ports import listen, next_port
from dashboards.viewer.headless import (
    WINDOWS,
    executable,
    free_port,
    start_rerun,
    start_window,
    viewer_log,
    wait_until_it_listens,
)
from tests.dashboards.cars import cars
from tests.dashboards.listeners import LOOPBACK, listeners

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="sockets are read from /proc")


def assert_loopback(*ports: int) -> None:
    found = listeners(os.getpid())
    assert set(ports) <= found.keys()
    assert set(found.values()) <= LOOPBACK, found


def test_a_socket_of_every_address_is_seen():
    with socket.create_server(("0.0.0.0", 0)) as everywhere, socket.create_server(("127.0.0.1", 0)) as here:
        found = listeners(os.getpid())
        assert found[everywhere.getsockname()[1]] not in LOOPBACK
        assert found[here.getsockname()[1]] in LOOPBACK


def test_the_page_of_a_league():
    with listen(free_port()) as listener:
        assert_loopback(listener.getsockname()[1])


def test_a_match_in_a_browser():
    port = free_port()
    with viewer.hub(port) as hub:
        assert_loopback(port, int(hub.feed.split(":")[-1].split("/")[0]))


def test_the_port_after_a_pages_is_its_viewers_unless_it_is_taken():
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        assert next_port(taken - 1) != taken
    assert next_port(taken - 1) == taken


def test_the_viewer_of_a_page():
    with viewer.web_viewer(free_port()) as (origin, _):
        assert_loopback(int(origin.rpartition(":")[2]))


def test_a_table_of_matches(tmp_path: Path):
    viewer.write_rrd(cars(), tmp_path / "1.rrd")
    port = free_port()
    with viewer.catalog(tmp_path, port):
        assert_loopback(port)


def test_a_picture(graphics):
    with viewer_log() as log:
        port = free_port()
        process = start_rerun(log, "--headless", "--port", str(port))
        try:
            wait_until_it_listens(process, log, port)
            assert_loopback(port)
        finally:
            process.kill()
            process.wait()


@pytest.fixture
def headless_windows(tmp_path: Path, monkeypatch):
    """Rerun's program, which takes the word --headless wherever a window would open."""
    program = tmp_path / "rerun"
    program.write_text(f'#!/bin/sh\nexec "{executable()}" --headless "$@"\n')
    program.chmod(0o755)
    monkeypatch.setenv("RERUN_CLI_PATH", str(program))
    monkeypatch.setenv("DISPLAY", ":0")
    yield
    for process in WINDOWS:
        process.kill()
        process.wait()
    WINDOWS.clear()


def test_a_window_without_a_driver_is_told_in_a_line(headless_windows, monkeypatch):
    """It listens, and ends a second later as it draws."""
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, "/nonexistent")
    monkeypatch.setenv("WGPU_BACKEND", "vulkan")
    with pytest.raises(ViewerError, match="window did not open here; it needs a display and a graphics driver; use --"):
        viewer.show(cars(), port=free_port())
    (window,) = WINDOWS
    assert window.wait(60) != 0


def test_the_window_of_a_match(graphics, headless_windows):
    port = free_port()
    viewer.show(cars(), port=port)
    assert_loopback(port)


def test_the_window_of_a_table_of_matches(graphics, headless_windows):
    port = free_port()
    process = start_window("--port", str(port))
    try:
        deadline = time.monotonic() + 60
        while port not in listeners(os.getpid()) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert_loopback(port)
    finally:
        process.kill()
        process.wait()
