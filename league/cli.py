"""The command `league`. Each command's module is imported when it is asked for: a query must not wait for jax."""

import os
import sys
from importlib import import_module

from league import environment

environment.prepare()

COMMANDS = {
    "run": ("league.run", "run a league: train, play rating matches, go on where it stopped"),
    "stop": ("league.control", "stop a running league, on whatever host it runs"),
    "status": ("league.control", "what runs, who learns, which jobs wait or failed"),
    "init": ("league.control", "write a commented league.toml"),
    "ratings": ("league.tables", "the ratings table"),
    "matches": ("league.tables", "the match log"),
    "snapshots": ("league.tables", "the frozen policies"),
    "watch": ("league.watch", "a recorded match in 3D"),
    "arenas": ("league.control", "the arenas and what they look like to a policy"),
    "check": ("league.control", "examine an arena, ours or your own: league check file.py:name"),
}


def main(argv: list[str] | None = None) -> None:
    """Run a command and exit: 0 when it did what was asked, 2 after bad input, 130 after Ctrl-C."""
    args = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in args
    args = [a for a in args if a != "--debug"]
    try:
        sys.exit(_dispatch(args))
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader left: nothing more to say
        sys.exit(0)
    except Exception as error:
        if debug:
            raise
        print(f"league: {_one_line(error)}", file=sys.stderr)
        sys.exit(2 if _is_expected(error) else 1)


def _dispatch(args: list[str]) -> int:
    if not args or args[0] in ("-h", "--help", "help"):
        print(_help())
        return 0 if args else 2
    if args[0] == "--version":
        from importlib.metadata import version

        print(version("robot-league"))
        return 0
    name = args[0]
    if name not in COMMANDS:
        from difflib import get_close_matches

        near = get_close_matches(name, COMMANDS, 1)
        hint = f"did you mean {near[0]}? " if near else ""
        print(f"league: unknown command {name!r}: {hint}(commands: {', '.join(COMMANDS)})", file=sys.stderr)
        return 2
    return getattr(import_module(COMMANDS[name][0]), name)(args[1:])


def _help() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  league {name:<{width}}  {what}" for name, (_, what) in COMMANDS.items()]
    return "\n".join(
        ["Self-play leagues for teams of robots.", "", *lines, "", "league COMMAND --help tells its options."]
    )


def _is_expected(error: Exception) -> bool:
    """Whether the user can do something about it: these say in one line what was given and what is possible."""
    from storage.errors import StorageError

    # The classes of modules that were never imported cannot have been raised.
    known: list[type] = [StorageError]
    for module, name in (
        ("league.settings", "ConfigError"), ("arenas.arena", "ArenaError"), ("arenas.engines", "EngineError"),
        ("dashboards.errors", "ViewerError"), ("league.daemon", "DaemonError"),
    ):  # fmt: skip
        if module in sys.modules:
            known.append(getattr(sys.modules[module], name))
    return isinstance(error, tuple(known))


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if _is_expected(error) else f"{type(error).__name__}: {text} (--debug shows where)"


if __name__ == "__main__":
    main()
