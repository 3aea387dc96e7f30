"""The command `league`, also as `python -m league`: examines what Python imports before it imports it."""

import sys

from league.system.packages import displaced


def main() -> None:
    """Run the command, or exit with 2 and one line if another package is in the place of one of ours."""
    if problem := displaced.displaced_package():
        print(f"league: {problem}", file=sys.stderr)
        sys.exit(2)
    from league.commands.cli import main as command

    command()


if __name__ == "__main__":
    main()
