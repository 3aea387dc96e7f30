"""The command `league`. It imports the module of a command only to run that command: a query must not wait for jax."""

import os
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from keyword import iskeyword

from league.system import environment, exit_codes, output_streams

environment.prepare()

COMMANDS = {
    "run": ("league.commands.run.run", "run a league: train, play rating matches, continue where it stopped"),
    "worker": ("league.commands.run.join", "work for a league that runs, from any host that reaches its store"),
    "stop": ("league.commands.run.stop", "stop a running league, on whatever host it runs"),
    "status": ("league.commands.run.status", "what runs, who learns, which jobs wait or were set aside"),
    "doctor": ("league.commands.run.doctor", "examine this machine: what is missing, and the command that brings it"),
    "init": ("league.commands.design.init", "write a commented league.toml"),
    "presets": ("league.commands.design.preset_list", "the presets, a line each; of one that is named, all settings"),
    "sweep": ("league.commands.run.sweep", "a grid of settings and seeds, each run a league of one store"),
    "compare": (
        "league.commands.analyse.compare",
        "leagues side by side: curves with bands, and one ladder by cross-play",
    ),
    "list": ("league.commands.store.leagues", "the leagues of a store, and whether they run"),
    "ratings": ("league.commands.analyse.ratings", "the ratings table"),
    "rate": ("league.commands.analyse.rate", "ratings of a match log of your own, from a CSV file"),
    "matches": ("league.commands.analyse.tables", "the match log"),
    "snapshots": ("league.commands.analyse.tables", "the frozen policies"),
    "curves": ("league.commands.analyse.tables", "how learning went, iteration by iteration"),
    "log": ("league.commands.watch.log", "learning curves as a folder for TensorBoard, once or following the league"),
    "explain": ("league.commands.analyse.explain", "whom a player meets in training now, how often, and why"),
    "payoff": ("league.commands.analyse.payoffs", "scores of the snapshots against each other"),
    "meta": ("league.commands.analyse.payoffs", "who would be played: Nash or alpha-rank mixture of a payoff table"),
    "forgetting": ("league.commands.analyse.payoffs", "players against their own past snapshots"),
    "demo": ("league.commands.watch.demo", "a match of trained teams that come with the package, without a store"),
    "watch": ("league.commands.watch.watch", "a recorded match in 3D"),
    "browse": ("league.commands.watch.browse", "the newest recorded matches as a table, each of which opens in 3D"),
    "export-match": ("league.commands.watch.export_match", "a recorded match as a file that Foxglove opens in 3D"),
    "dash": ("league.commands.watch.dash", "the league as a page in a browser of this machine, which follows it"),
    "report": ("league.commands.watch.report", "the same page as one file, to keep or to send"),
    "gate": ("league.commands.play.gate", "whether one snapshot is better than another, by a sequential test"),
    "play": ("league.commands.play.play", "an exhibition between two snapshots, recorded and not rated"),
    "exploit": (
        "league.commands.play.exploit",
        "train a fresh attacker against one frozen policy: how much does it take?",
    ),
    "exploitability": (
        "league.commands.play.known_games",
        "exact exploitability of a policy in a small game: Kuhn and Leduc poker, dark hex",
    ),
    "bench": (
        "league.commands.play.bench",
        "a policy of yours against the frozen tasks and public references of Robot League Bench",
    ),
    "grid": (
        "league.commands.play.grid",
        "snapshots over a grid of masses and frictions: mean, worst tenth and worst cell",
    ),
    "sprt": (
        "league.commands.analyse.sprt",
        "a sequential test of who is better, for seed pairs that you have counted",
    ),
    "migrate": ("league.commands.store.migrate", "bring the store of an earlier version up to date"),
    "verify": ("league.commands.store.verify", "whether all that a store has is there and whole; changes nothing"),
    "thin": ("league.commands.store.thin", "remove what a store can do without: orphans, old checkpoints, recordings"),
    "pack": ("league.commands.store.archives", "a league, or all leagues of a store, as one file"),
    "unpack": ("league.commands.store.archives", "the leagues in such a file, added to a store"),
    "export": ("league.commands.store.policies", "a frozen policy as a safetensors file, with its card"),
    "import": ("league.commands.store.policies", "such a file as a fixed player of a league"),
    "arenas": ("league.commands.design.arenas", "the arenas; of one that is named, all about it"),
    "robot": (
        "league.commands.design.robot",
        "read a robot from an MJCF or URDF file, try it, and write its settings",
    ),
    "check": ("league.commands.design.check", "examine an arena, ours or your own: league check file.py:name"),
}

LINE = 3000
"""Maximum characters of an error message, which contains names as the user gave them and lists of possible values."""


def main(argv: list[str] | None = None) -> None:
    """Run a command and exit with one of the codes of `league.system.exit_codes`."""
    _open_what_is_closed()
    args = list(sys.argv[1:] if argv is None else argv)
    sys.exit(guarded(lambda: _dispatch([a for a in args if a != "--debug"]), "--debug" in args))


def guarded(action: Callable[[], int], debug: bool = False) -> int:
    """Run an action and return its exit code. Print an error in one line, or with `debug` in full."""
    with output_streams.installed():
        return _guarded(action, debug)


def _guarded(action: Callable[[], int], debug: bool) -> int:
    try:
        code = _code(action)
        sys.stdout.flush()  # a full disk may show only here
        return code
    except KeyboardInterrupt:
        return 130
    except output_streams.ReaderLeft:
        return 0
    except Exception as error:
        if _is_interrupt(error):
            return 130
        if debug:
            raise
        print(f"league: {one_line(error)}", file=sys.stderr)
        return exit_codes.of(error) if is_expected(error) else exit_codes.NO


def _is_interrupt(error: Exception) -> bool:
    """Return whether Ctrl-C stopped the engine's steps in a program that was not made `interruptible`."""
    if type(error).__name__ != "JaxRuntimeError":  # most commands never load JAX
        return False
    from arenas.physics.interrupts import is_interrupt

    return is_interrupt(error)


def _code(action: Callable[[], int]) -> int:
    """Return the exit code of an action, which may end with SystemExit as help pages do."""
    try:
        return action()
    except SystemExit as ended:
        if isinstance(ended.code, str):
            raise
        return ended.code or 0


def _open_what_is_closed() -> None:
    """Open closed standard streams: else the store could get their file number, and print would write into it."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)
            if null != number:
                os.dup2(null, number)
                os.close(null)
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115


def _leave(number: int, frame: object) -> None:
    """Exit at once. Python can drop a KeyboardInterrupt, for example one that arrives during an import."""
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
    if before == signal.default_int_handler:  # nothing has started yet that needs an orderly end
        signal.signal(signal.SIGINT, _leave)
    try:
        command = getattr(import_module(COMMANDS[name][0]), f"{name}_" if iskeyword(name) else name.replace("-", "_"))
        if name != "run":  # `run` decides itself when it needs an orderly end
            signal.signal(signal.SIGINT, before)
        return command(args[1:])
    finally:
        signal.signal(signal.SIGINT, before)


def _help() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  league {name:<{width}}  {what}" for name, (_, what) in COMMANDS.items()]
    return "\n".join(
        [
            "Self-play leagues for teams of robots.",
            "",
            *lines,
            "",
            "league COMMAND --help tells its options.",
            "",
            "Exit codes:",
            *(f"  {code:<3}  {meaning}" for code, meaning in exit_codes.MEANINGS.items()),
        ]
    )


def is_expected(error: Exception) -> bool:
    """Return True for errors that a user can correct: one line states the value given and the possible values."""
    from storage.errors import StorageError

    # The classes of modules that were never imported cannot have been raised.
    known: list[type] = [StorageError]
    for module, name in (
        ("league.config.schema", "ConfigError"), ("arenas.errors", "ArenaError"), ("arenas.errors", "EngineError"),
        ("agents.devices.rendezvous", "RanksError"),
        ("dashboards.errors", "ViewerError"), ("league.runtime.manager", "ManagerError"),
        ("league.runtime.preflight", "PrepareError"),
    ):  # fmt: skip
        if module in sys.modules:
            known.append(getattr(sys.modules[module], name))
    return isinstance(error, tuple(known))


def one_line(error: Exception) -> str:
    """Return an error as one line: its message, or for a fault of the program its type too."""
    text = " ".join(str(error).split())
    if "@" in text or "=" in text:  # a password in a store's address has these characters beside it
        from storage.database.urls import without_passwords

        text = without_passwords(text)
    text = text if len(text) <= LINE else f"{text[: LINE - 300]} ... {text[-200:]}"
    return text if is_expected(error) else f"{type(error).__name__}: {text} (--debug shows where)"


if __name__ == "__main__":
    main()
