"""A run of a league in a process of its own, started from Python: its output, its end, and how it is stopped.

The process is that of `league run`. It imports nothing from the program that starts it, so a script needs no
`if __name__ == "__main__"`, a notebook works, and Ctrl-C reaches the run only through `ChildRun.interrupt`. It also
stops when the program that started it is gone.
"""

import codecs
import json
import os
import queue
import signal
import subprocess
import threading
from collections.abc import Iterator, Mapping
from contextlib import suppress

from league.config.experiment import Config
from league.config.run_spec import RunSpec
from league.config.schema import ConfigError
from league.system import exit_codes, provenance

MODULE = "league.commands.run.child_process"
"""The module that the process runs; above this room, and so only named."""
BY_CTRL_C = (130, -signal.SIGINT)
"""Exit codes of a process that Ctrl-C ended before it could stop cleanly; the second before Python has its handler."""
AT_START = 1
"""Exit code of Python that Ctrl-C ends as it imports `site`; a run that ends with a fault has it too, but answers."""
TICK = 0.5  # seconds between two looks at the process while it prints nothing


class RunError(Exception):
    """A league could not run, or ended with a fault. The message is one line for the user.

    `transient`: the same call may succeed later, although nobody changes anything.
    """

    def __init__(self, message: str, transient: bool = False):
        super().__init__(message)
        self.transient = transient


class ChildRun:
    """A run of a league in a process of its own, which begins at once."""

    def __init__(self, store: str, config: Config, width: int | None = None, environment: Mapping[str, str] = {}):
        """Start the process.

        Args:
            store: folder or URL of the store.
            config: the league.
            width: columns of a status line that is written again and again, as on a terminal; None for a line every
                few seconds.
            environment: variables that the process has beside those of this one.
        """
        spec = RunSpec.of(store, config)
        request = {"store": store, "blobs": spec.blobs, "config_toml": spec.config_toml, "width": width}
        reading, writing = os.pipe()
        self._process = subprocess.Popen(
            provenance.command(MODULE, str(writing)), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, start_new_session=True, pass_fds=(writing,), env={**os.environ, **environment},
        )  # fmt: skip
        os.close(writing)
        self._answer, self._interrupted = os.fdopen(reading, encoding="utf-8"), False
        self._texts: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
            self._process.stdin.flush()

    def output(self) -> Iterator[str]:
        """Yield what the run prints until it ends; an empty text at least every TICK seconds."""
        while self._process.poll() is None:
            try:
                yield self._texts.get(timeout=TICK)
            except queue.Empty:
                yield ""
        self._reader.join(timeout=1.0)  # workers that still end hold the pipe open
        while not self._texts.empty():
            yield self._texts.get()

    def discard(self) -> None:
        """Throw away what the run has printed so far."""
        while not self._texts.empty():
            self._texts.get()

    def running(self) -> bool:
        """Return whether the process has not ended."""
        return self._process.poll() is None

    def interrupt(self) -> None:
        """Ask the run to finish its iteration and to stop, as Ctrl-C does; a second time, to stop at once."""
        if self.running():
            self._interrupted = True
            self._process.send_signal(signal.SIGINT)

    def end(self) -> None:
        """Wait for the end. Raises ConfigError or RunError, one line, if the run failed.

        Raises KeyboardInterrupt if `interrupt` ended it before it began, or at once.
        """
        code = self._process.wait()
        text = self._answer.read()
        self.close()
        if code == 0:
            return
        if self._interrupted and (code in BY_CTRL_C or (code == AT_START and not text)):
            raise KeyboardInterrupt
        found = json.loads(text) if text else {}
        message = found.get("error") or f"the process of the run ended with exit code {code}"
        if found.get("kind") == ConfigError.__name__:
            raise ConfigError((), message)
        raise RunError(message, transient=code == exit_codes.PASSING or code < 0)

    def close(self) -> None:
        """Close the pipes; a run that is under way stops after its iteration."""
        for pipe in filter(None, (self._process.stdin, self._answer)):
            with suppress(OSError):
                pipe.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        decoder = codecs.getincrementaldecoder("utf-8")("replace")
        with self._process.stdout as out:
            while data := os.read(out.fileno(), 65536):
                if text := decoder.decode(data):
                    self._texts.put(text)
