"""Matches shown while a league runs: `league watch --live` in a process of its own, beside `league run --live`."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from dashboards import viewer
from dashboards.errors import ViewerError
from dashboards.viewer.headless import LAUNCH
from league.config.run_spec import RunSpec
from league.system import provenance

END = 5.0  # seconds that the process has to end


@contextmanager
def live_matches(spec: RunSpec, league: str, port: int = 9090) -> Iterator[None]:
    """Show every match that the league records during the block: in a window, or in a browser where none can open.

    A window stays open after the block; a page, at this port of 127.0.0.1, ends with it and with this process. If the
    viewer cannot start, it prints one line and the league runs on.
    """
    command = ["league", "watch", "--live", "--store", spec.store, "--league", league, "--port", str(port)]
    if spec.blobs is not None:
        command += ["--blobs", spec.blobs]
    try:
        viewer.require_display()
    except ViewerError:
        command.append("--web")
    launch = [sys.executable, "-I", "-c", LAUNCH, str(os.getpid())]
    process = subprocess.Popen([*launch, *provenance.command(*command)], stdin=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(END)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
