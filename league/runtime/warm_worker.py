"""The process that has prepared a league becomes its train worker: it has all imports, and the arena, already.

That happens only if the process is equivalent to a spawned worker: single-device training on the first GPU, which is
the GPU that prepared the league. If turns are spread over devices, the worker itself has no device. All other workers
are spawned, as is the worker that replaces this process when it dies.

The process that has checked a curriculum prepares also its first stage, and becomes a worker of that.
"""

import io
import json
import os
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from typing import Any

from league.config.experiment import Config, stage
from league.config.run_spec import RunSpec
from league.runtime.worker_process import WorkerSpec, run_process
from league.system import provenance
from league.system.arena_build import Built

KEPT_LINES = 100  # newest lines kept of the process's output while it prepares


def can_become_worker(config: Config) -> bool:
    """Return whether the process that prepares this league, or all its stages, can be its first train worker."""
    leagues = [stage(config, number) for number in range(len(config.stages))] or [config]
    return all(each.training.devices == 1 and each.workers.train > 0 for each in leagues)


# In the manager's process --------------------------------------------------------------------------------------------


class WarmWorker:
    """A process that answers requests and then waits to become a worker.

    A manager handles it as a process that it has spawned itself: it has the methods of multiprocessing's processes.
    """

    def __init__(self, module: str, debug: bool):
        self._outputs = [_duplicate(1), _duplicate(2)]
        self._process = subprocess.Popen(
            provenance.command(module), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=None if debug else subprocess.PIPE, text=True, errors="replace", pass_fds=self._outputs,
        )  # fmt: skip
        for copy in self._outputs:
            os.close(copy)
        self._lines: deque[str] = deque(maxlen=KEPT_LINES)
        self._reader = threading.Thread(target=self._lines.extend, args=(self._process.stderr or (),), daemon=True)
        self._reader.start()  # all the while, so that a full pipe never blocks the process

    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return the answer to a request; an empty one if the process dies during the request.

        A process that has died has ended when this returns, and all that it printed has been read.
        """
        assert self._process.stdout is not None
        self.send(request)
        answer = self._process.stdout.readline()
        if answer.endswith("\n"):
            return json.loads(answer)
        self._process.wait()
        self._reader.join()
        return {}

    def send(self, request: Mapping[str, Any]) -> None:
        """Send a request that has no answer. The death of the process is noticed elsewhere."""
        self._send({**request, "outputs": self._outputs})

    def last_line(self) -> str:
        """Return the last line that the process has printed."""
        return next((line.strip() for line in reversed(self._lines) if line.strip()), "it said nothing")

    def assign(self, spec: WorkerSpec) -> None:
        """Make the process the worker of `spec`; from now on it prints to the terminal."""
        self._send(asdict(spec))
        self._close_stdin()

    def end(self) -> None:
        """End the process at once, even during work: its results are in the store."""
        self.kill()
        self.join()
        self._reader.join()
        self._close_stdin()
        for pipe in filter(None, (self._process.stdout, self._process.stderr)):
            pipe.close()

    def _send(self, message: Mapping[str, Any]) -> None:
        """Send a message as one line. The death of the process is noticed elsewhere."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()

    def _close_stdin(self) -> None:
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()

    # As in multiprocessing's processes -------------------------------------------------------------------------------

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    @property
    def exitcode(self) -> int | None:
        """The exit code, minus the signal's number if a signal ended the process; None while it is alive."""
        return self._process.poll()

    def is_alive(self) -> bool:
        """Return whether the process has not ended."""
        return self._process.poll() is None

    def terminate(self) -> None:
        """Ask the process to end."""
        self._process.terminate()

    def kill(self) -> None:
        """Kill the process."""
        self._process.kill()

    def join(self) -> None:
        """Wait for the end of the process."""
        self._process.wait()


def _duplicate(stream: int) -> int:
    """Return a second descriptor of an output, for a process whose own is a pipe; /dev/null if the output is closed."""
    try:
        return os.dup(stream)
    except OSError:
        return os.open(os.devnull, os.O_WRONLY)


# In the process that has prepared ------------------------------------------------------------------------------------


def await_message() -> dict[str, Any]:
    """Wait for a request or a WorkerSpec, and return it; an empty one if the parent is gone."""
    line = sys.stdin.readline()
    return json.loads(line) if line.endswith("\n") else {}


def become_worker(outputs: Sequence[int], spec: Mapping[str, Any], built: Built) -> None:
    """Work like a spawned process, whose outputs are these descriptors."""
    sys.stdout.flush()
    nothing = os.open(os.devnull, os.O_RDONLY)
    for copy, stream in zip((nothing, *outputs), (0, 1, 2), strict=True):
        os.dup2(copy, stream)
        os.close(copy)
    assert isinstance(sys.stdout, io.TextIOWrapper)
    sys.stdout.reconfigure(line_buffering=sys.stdout.isatty())
    run_process(WorkerSpec(**{**spec, "run": RunSpec(**spec["run"]), "kinds": tuple(spec["kinds"])}), built)
