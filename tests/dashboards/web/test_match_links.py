"""Matches served to browsers: a hub that keeps what it was sent, and a table of many."""

import http.client
import socket
import time
from dataclasses import replace

import pytest

from dashboards import viewer
from dashboards.errors import ViewerError
from dashboards.viewer.headless import free_port, headless_viewer
from tests.dashboards.cars import STEPS, cars


def page(port: int) -> str:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    try:
        connection.request("GET", "/")
        return connection.getresponse().read().decode()
    finally:
        connection.close()


def listens(port: int) -> bool:
    with socket.socket() as asked:
        return asked.connect_ex(("127.0.0.1", port)) == 0


def test_who_joins_late_sees_every_match_that_was_sent(graphics):
    match, port = cars(), free_port()
    with viewer.hub(port) as hub:
        for seed in (1, 2):
            hub.send(replace(match, header=replace(match.header, seed=seed)))
        assert "rerun" in page(port).lower()
        assert f"127.0.0.1:{port}/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A" in hub.address
        with headless_viewer((64, 64)) as late:
            late.open(hub.feed)
            deadline = time.monotonic() + 60
            while time.monotonic() < deadline:
                ends = [t.end for r in late.state().recordings for t in r.timelines if t.name == "step"]
                if ends == [STEPS - 1] * 2:
                    break
                time.sleep(0.1)
            assert ends == [STEPS - 1] * 2
    assert not listens(port)


def test_a_table_of_matches_is_served_and_ends_with_the_block(tmp_path):
    viewer.write_rrd(cars(), tmp_path / "1.rrd")
    port = free_port()
    with viewer.catalog(tmp_path, port) as address:
        assert address.startswith(f"http://127.0.0.1:{port}/?url=rerun%2Bhttp")
        assert "rerun" in page(port).lower()
    assert not listens(port)


def test_a_port_that_is_taken_is_told_with_one_that_is_free(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        for serving in (viewer.hub(port), viewer.catalog(tmp_path, port)):
            with pytest.raises(ViewerError, match=rf"port {port} is taken.*--port \d+"), serving:
                pass
