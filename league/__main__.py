"""The command `league`, also as `python -m league`: examines what Python imports before it imports it."""

import os
import sys
from contextlib import suppress

from league.system.packages import displaced


def main() -> None:
    """Run the command, or exit with 2 and one line if another package is in the place of one of ours."""
    if problem := displaced.displaced_package():
        print(f"league: {problem}", file=sys.stderr)
        sys.exit(2)
    from league.commands.cli import main as command

    try:
        command()
    except SystemExit as end:
        if end.code == 130 and "jax" in sys.modules:  # Ctrl-C
            with suppress(OSError, ValueError):
                sys.stdout.flush()
            os._exit(130)  # XLA's threads may still compile, and crash an interpreter that is torn down under them
        raise


if __name__ == "__main__":
    main()
