"""The process that has prepared a league goes on as its train worker: it has all imports, and the arena, already.

It does so where it surely is what a spawned one would be: one that trains by itself, on the first GPU, which is the one
that it has prepared on. Where turns are spread over devices a worker has none. Of a league of stages nobody goes on
before its manager prepares a stage. Any other worker is spawned, also the one that replaces this one when it dies.
"""

import io
import json
import os
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from typing import Any

from league.config.experiment import Config
from league.examine import Built
from league.worker import Post, work

SAID = 100  # newest lines that are kept of what the process says while it prepares


def goes_on(config: Config) -> bool:
    """Whether who prepares this league can be its first train worker."""
    return config.training.devices == 1 and not config.stages


# In the manager's process --------------------------------------------------------------------------------------------


class Standby:
    """A process that answers a request and then waits for a post; a manager treats it as one that it has spawned."""

    def __init__(self, module: str, debug: bool):
        self._outputs = [_again(1), _again(2)]
        self._process = subprocess.Popen(
            [sys.executable, "-m", module], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=None if debug else subprocess.PIPE, text=True, errors="replace", pass_fds=self._outputs,
        )  # fmt: skip
        self._said: deque[str] = deque(maxlen=SAID)
        self._listening = threading.Thread(target=self._said.extend, args=(self._process.stderr or (),), daemon=True)
        self._listening.start()  # all the while, so that a pipe that is full holds nobody up

    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """What it answers; nothing where it dies over it, and then it has ended and has said its last."""
        assert self._process.stdout is not None
        self._tell({**request, "outputs": self._outputs, "path": sys.path})
        for copy in self._outputs:
            os.close(copy)
        answer = self._process.stdout.readline()
        if answer.endswith("\n"):
            return json.loads(answer)
        self._process.wait()
        self._listening.join()
        return {}

    def last_words(self) -> str:
        """The last line that it has said."""
        return next((line.strip() for line in reversed(self._said) if line.strip()), "it said nothing")

    def hire(self, post: Post) -> None:
        """Let it work there; from now on it says to the terminal what it has to say."""
        self._tell(asdict(post))
        self._hang_up()

    def end(self) -> None:
        """End it at once, whatever it does: what it has done is in the store."""
        self.kill()
        self.join()
        self._listening.join()
        self._hang_up()
        for pipe in filter(None, (self._process.stdout, self._process.stderr)):
            pipe.close()

    def _tell(self, what: Mapping[str, Any]) -> None:
        """Say it in a line; one that has died is found dead, not here."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(what) + "\n")
            self._process.stdin.flush()

    def _hang_up(self) -> None:
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()

    # As multiprocessing's processes have it --------------------------------------------------------------------------

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def exitcode(self) -> int | None:
        """Its exit code, minus a signal's number where that ended it; None while it is alive."""
        return self._process.poll()

    def is_alive(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def terminate(self) -> None:
        """Ask it to end."""
        self._process.terminate()

    def kill(self) -> None:
        """End it."""
        self._process.kill()

    def join(self) -> None:
        """Wait for its end."""
        self._process.wait()


def _again(stream: int) -> int:
    """A second descriptor of an output, for a process whose own is a pipe; of one that is closed, to nowhere."""
    try:
        return os.dup(stream)
    except OSError:
        return os.open(os.devnull, os.O_WRONLY)


# In the process that has prepared ------------------------------------------------------------------------------------


def stand_by(request: Mapping[str, Any], built: Built) -> None:
    """Wait for a post and work there, as one that was spawned; end where nobody gives it one, or who asked is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it may reach the whole group; the manager decides
    sys.path[:] = request["path"]
    import league.train  # noqa: F401  (with torch: what preparing does not need, while the manager begins)

    told = sys.stdin.readline()
    if not told.endswith("\n"):
        return
    sys.stdout.flush()
    nothing = os.open(os.devnull, os.O_RDONLY)
    for copy, stream in zip((nothing, *request["outputs"]), (0, 1, 2), strict=True):
        os.dup2(copy, stream)
        os.close(copy)
    assert isinstance(sys.stdout, io.TextIOWrapper)
    sys.stdout.reconfigure(line_buffering=sys.stdout.isatty())
    post = json.loads(told)
    work(Post(**{**post, "kinds": tuple(post["kinds"])}), built)
