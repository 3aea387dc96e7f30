"""The command `league`. Each command's module is imported when it is asked for: a query must not wait for jax."""

import os
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from keyword import iskeyword

from league import environment

environment.prepare()

COMMANDS = {
    "run": ("league.commands.run", "run a league: train, play rating matches, go on where it stopped"),
    "worker": ("league.commands.worker", "work for a league that runs, from any host that reaches its store"),
    "stop": ("league.commands.stop", "stop a running league, on whatever host it runs"),
    "status": ("league.commands.status", "what runs, who learns, which jobs wait or were set aside"),
    "init": ("league.commands.init", "write a commented league.toml"),
    "ratings": ("league.commands.ratings", "the ratings table"),
    "rate": ("league.commands.rate", "ratings of a match log of your own, from a CSV file"),
    "matches": ("league.commands.tables", "the match log"),
    "snapshots": ("league.commands.tables", "the frozen policies"),
    "curves": ("league.commands.tables", "how learning went, iteration by iteration"),
    "log": ("league.commands.log", "learning curves as a folder for TensorBoard, once or following the league"),
    "explain": ("league.commands.explain", "whom a player meets in training now, how often, and why"),
    "payoff": ("league.commands.meta", "scores of the snapshots against each other"),
    "meta": ("league.commands.meta", "who would be played: Nash or alpha-rank mixture of a payoff table"),
    "forgetting": ("league.commands.meta", "players against their own past snapshots"),
    "watch": ("league.commands.watch", "a recorded match in 3D"),
    "browse": ("league.commands.browse", "the newest recorded matches as a table, each of which opens in 3D"),
    "export-match": ("league.commands.export_match", "a recorded match as a file that Foxglove opens in 3D"),
    "dash": ("league.commands.dash", "the league as a page in a browser of this machine, which follows it"),
    "report": ("league.commands.report", "the same page as one file, to keep or to send"),
    "gate": ("league.commands.gate", "whether one snapshot is better than another, by a sequential test"),
    "play": ("league.commands.play", "an exhibition between two snapshots, recorded and not rated"),
    "exploit": ("league.commands.exploit", "train a fresh attacker against one frozen policy: how much does it take?"),
    "sprt": ("league.commands.sprt", "a sequential test of who is better, for seed pairs that you have counted"),
    "migrate": ("league.commands.migrate", "bring the store of an earlier version up to date"),
    "verify": ("league.commands.verify", "whether all that a store has is there and whole; changes nothing"),
    "thin": ("league.commands.thin", "remove what a store can do without: orphans, old checkpoints, recordings"),
    "pack": ("league.commands.moving", "a league, or all leagues of a store, as one file"),
    "unpack": ("league.commands.moving", "the leagues in such a file, added to a store"),
    "export": ("league.commands.exchange", "a frozen policy as a safetensors file, with its card"),
    "import": ("league.commands.exchange", "such a file as a fixed player of a league"),
    "arenas": ("league.commands.arenas", "the arenas; of one that is named, all about it"),
    "check": ("league.commands.check", "examine an arena, ours or your own: league check file.py:name"),
}

LINE = 3000
"""Characters of an error at most: names that somebody gave stand in it as they are, and lists of what is possible."""


def main(argv: list[str] | None = None) -> None:
    """Run a command and exit: 0 when it did what was asked, 2 after bad input, 130 after Ctrl-C."""
    _open_what_is_closed()
    args = list(sys.argv[1:] if argv is None else argv)
    sys.exit(guarded(lambda: _dispatch([a for a in args if a != "--debug"]), "--debug" in args))


def guarded(action: Callable[[], int], debug: bool = False) -> int:
    """Do something and return its exit code; tell what goes wrong in one line, or with `debug` in full."""
    try:
        return action()
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader left: nothing more to say
        return 0
    except Exception as error:
        if debug:
            raise
        print(f"league: {_one_line(error)}", file=sys.stderr)
        return 2 if _is_expected(error) else 1


def _open_what_is_closed() -> None:
    """Have all three standard streams: else the store would be opened as one, and be written to by who prints."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)
            if null != number:
                os.dup2(null, number)
                os.close(null)
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115


def _leave(number: int, frame: object) -> None:
    """End at once. Python drops a KeyboardInterrupt that comes while, say, a module is being imported."""
    os._exit(128 + number)


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
        print(f"league: unknown command {name[:80]!r}: {hint}(commands: {', '.join(COMMANDS)})", file=sys.stderr)
        return 2
    before = signal.getsignal(signal.SIGINT)
    if before == signal.default_int_handler:  # nothing has been begun that would have to be ended in order
        signal.signal(signal.SIGINT, _leave)
    try:
        command = getattr(import_module(COMMANDS[name][0]), f"{name}_" if iskeyword(name) else name.replace("-", "_"))
        if name != "run":  # that one decides for itself when there is something to end
            signal.signal(signal.SIGINT, before)
        return command(args[1:])
    finally:
        signal.signal(signal.SIGINT, before)


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
        ("league.config.schema", "ConfigError"), ("arenas.errors", "ArenaError"), ("arenas.errors", "EngineError"),
        ("dashboards.errors", "ViewerError"), ("league.daemon", "DaemonError"), ("league.prepare", "PrepareError"),
    ):  # fmt: skip
        if module in sys.modules:
            known.append(getattr(sys.modules[module], name))
    return isinstance(error, tuple(known))


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    text = text if len(text) <= LINE else f"{text[: LINE - 300]} ... {text[-200:]}"
    return text if _is_expected(error) else f"{type(error).__name__}: {text} (--debug shows where)"


if __name__ == "__main__":
    main()
