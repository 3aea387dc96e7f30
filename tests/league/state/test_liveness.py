"""Who of a league's processes counts as alive on this host."""

import os
import socket
import subprocess
import sys

import pytest

from league.state.liveness import is_dead


@pytest.fixture
def child():
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, stderr=subprocess.DEVNULL) as child:
        yield child
        child.kill()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="tells so from /proc")
def test_who_was_killed_and_not_yet_waited_for_is_dead(child):
    """As where a supervisor, or a container's first process, has not looked after its children yet."""
    name = f"{socket.gethostname()}:{child.pid}:manager"
    assert not is_dead(name)
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)  # it has ended, and its entry stays
    assert is_dead(name)
    child.wait()
    assert is_dead(name)
