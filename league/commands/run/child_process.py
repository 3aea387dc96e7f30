"""The process of a run that a Python program has started (`league.runs.child_run`)."""

import io
import json
import os
import signal
import sys
import threading
import traceback
from typing import Any

from league.commands import cli
from league.commands.run.request import RunOptions, RunRequest
from league.commands.run.run import execute
from league.config import experiment
from league.system import exit_codes


class _Relayed(io.TextIOWrapper):
    """An output that the starting program shows on a terminal or in a notebook: the status line is rewritten there."""

    def isatty(self) -> bool:
        """Return True."""
        return True


def main() -> int:
    """Read the request from stdin, run the league, and write the reason of a failure to the pipe that argv names."""
    stdin = io.FileIO(0, closefd=False)
    request = json.loads(stdin.readline())
    threading.Thread(target=_stop_at_the_end_of, args=(stdin,), daemon=True).start()
    if request["width"] is not None:
        os.environ["COLUMNS"] = str(request["width"])
        sys.stdout = _Relayed(sys.stdout.buffer, encoding="utf-8", errors="replace", write_through=True)
    with os.fdopen(int(sys.argv[1]), "w", encoding="utf-8") as answer:
        try:
            return _execute(request)
        except KeyboardInterrupt:
            return 130
        except Exception as error:
            expected = cli.is_expected(error)
            if not expected:
                traceback.print_exc()
            json.dump({"kind": type(error).__name__, "error": cli.one_line(error)}, answer)
            return exit_codes.of(error) if expected else exit_codes.NO
        finally:
            sys.stdout.flush()


def _execute(request: dict[str, Any]) -> int:
    options = RunOptions(store=request["store"], blobs=request["blobs"])
    config = experiment.loads(request["config_toml"], "settings")
    return execute(RunRequest(options, config, False, False, None, "", {}, {}))


def _stop_at_the_end_of(stdin: io.FileIO) -> None:
    """Stop the run when the program that started it has gone: nobody else would."""
    while stdin.read(1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
