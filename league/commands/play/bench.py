"""`league bench`: a policy against the frozen tasks of the bench; `league bench page` and `league bench rerate`."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dashboards.tables import Column, render
from league.commands.options import parse, positional
from league.commands.progress_bar import Progress
from league.config import text_files
from league.config.schema import ConfigError
from league.config.sections import check_name
from league.runs.bench import tasks
from league.runs.bench.tasks import GAMES, TASKS, TRACKS, Task
from storage.blobs.files import require_writable

WHAT = """Measure a policy against the public references of a frozen task, and write the result as one JSON file:
`league bench TASK --entry FILE ...`, several files for several seeds, and TEAM=FILE where the sides are unlike. A FILE
is one that `league export` wrote, x.onnx, x.pt or x.py:function, with commas between those of a team's agents.
`league bench page FOLDER` writes the table of such files as a page, `league bench rerate FOLDER` computes it again."""


def _named(value: str) -> None:
    check_name(value)


@dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """The task, the entry's policies, and the file to write."""

    task: str | None = positional(None)
    """A task of `league bench --list`; without an entry, all about it."""
    entry: tuple[str, ...] = positional((), many=True)
    """The policies to measure, after --entry."""
    list: bool = False
    """List the tasks."""
    name: str = field(default="entry", metadata={"valid": _named})
    """The entry's name in tables."""
    about: str = ""
    """A line about it: the learner, its steps and seeds."""
    track: str | None = None
    """The task's track that it keeps to, such as 50M; `league bench TASK` lists them (none: none of them)."""
    out: str | None = None
    """The file to write, never over another one (none: TASK-NAME.json)."""
    games: int = field(default=GAMES, metadata={"low": 2})
    """Games of each pair; with fewer than the default, the result is a trial."""
    seed: int | None = field(default=None, metadata={"low": 0})
    """Seed of the games, for selecting a policy (none: that of records); the result is then a trial."""
    attack: int | None = field(default=None, metadata={"low": 1})
    """Steps of fresh attackers, which learn for so many and for three times as many (none: not measured), in
    whole iterations."""
    attackers: int = field(default=1, metadata={"low": 1, "high": 16})
    """Attackers of each policy, each with a seed of its own; the best of several is scored by further games."""
    curve: str | None = None
    """A CSV file with lines SECONDS,FILE: policies of one training and their times, for the seconds to 75 %."""
    against: tuple[str, ...] = ()
    """References to meet, such as pusher,idle (none: all); the result is then a trial."""


NO_RANK = ", more than 1 % by its own doing, which is no rank (rule 6 of docs/bench.md)"
OF_GAMES = ("games", "seed", "attack", "attackers", "curve", "against")


def bench(args: list[str]) -> int:
    """Measure an entry, list the tasks, or hand over to `page` and `rerate`."""
    if args and args[0] in ("page", "rerate"):
        from league.commands.play import bench_folder

        return (bench_folder.page if args[0] == "page" else bench_folder.rerate)(args[1:])
    options = parse(BenchOptions, _without_flag(args), "bench", WHAT)
    if options.list:
        print(_listing())
        return 0
    if options.task is None:
        raise ConfigError(
            (), "league bench needs a TASK, page FOLDER or rerate FOLDER: league bench --list has the tasks"
        )
    task = tasks.find(options.task)
    if not options.entry and "--entry" in args:
        raise ConfigError(("entry",), f"--entry names no policy: league bench {task.name} tells what it needs")
    if not options.entry:
        print(_all_about(task))
        return 0
    return _measure(task, options)


def _without_flag(args: Sequence[str]) -> list[str]:
    """Return the arguments without the flag --entry, whose values are all words that follow."""
    return [word.removeprefix("--entry=") for word in args if word != "--entry"]


def _measure(task: Task, options: BenchOptions) -> int:
    from league.runs.bench import entry_file
    from league.runs.bench.evaluation import Request, evaluate

    path = Path(options.out or f"{task.name}-{options.name}.json")
    if path.exists():
        raise ConfigError(("out",), f"{path} exists: give another --out or --name, or remove it")
    partial = path.with_name(f"{path.name}.part")
    require_writable(partial)
    default = BenchOptions()
    if task.exact and (given := [each for each in OF_GAMES if getattr(options, each) != getattr(default, each)]):
        raise ConfigError((given[0],), f"--{given[0]} is for games, and {task.name} plays none: leave it out")
    if options.track not in (None, *task.tracks):
        raise ConfigError(
            ("track",), f"--track is {options.track!r}, and {task.name} has {', '.join(task.tracks) or 'no tracks'}"
        )
    request = Request(
        name=options.name, about=options.about, track=options.track, games=options.games, seed=options.seed,
        against=options.against, attack=options.attack, attackers=options.attackers, curve=_curve(options.curve),
        partial=None if task.exact else partial,
    )  # fmt: skip
    try:
        with Progress("league bench") as progress:
            content = evaluate(
                task, options.entry, request, lambda done, of: progress.tell("games", done, of),
                lambda line: print(f"league bench: {line}", file=sys.stderr),
            )  # fmt: skip
    except KeyboardInterrupt:
        kept = f"what was played is in {partial}, and the same command goes on from there"
        print(f"league bench: stopped; {kept if partial.exists() else 'nothing was played yet'}", file=sys.stderr)
        raise
    entry_file.write(path, content)
    partial.unlink(missing_ok=True)
    print(_result(task, content))
    print(f"Wrote {path}.")
    return 0


def _curve(file: str | None) -> tuple[tuple[float, str], ...]:
    """Return the times and policies in a CSV file. Raises ConfigError, one line with the line that is none."""
    if file is None:
        return ()
    found = []
    for number, line in enumerate(text_files.read(file).splitlines(), 1):
        seconds, comma, policy = line.partition(",")
        try:
            time = float(seconds)
        except ValueError:
            time = -1.0
        if not (comma and policy.strip() and 0 <= time < float("inf")):
            raise ConfigError(
                ("curve",), f"{file}, line {number}: {line[:80]!r} is not SECONDS,FILE, such as 60,a.onnx (no header)"
            )
        found.append((time, policy.strip()))
    if not found:
        raise ConfigError(("curve",), f"{file} is empty: its lines are SECONDS,FILE, such as 60,a.onnx (no header)")
    return tuple(found)


def _listing() -> str:
    rows = [
        {"task": task.name, "sides": " against ".join(dict.fromkeys(task.sides)), "about": task.about}
        for task in TASKS.values()
    ]
    return render(rows, (Column("task", no_wrap=True), "sides", "about"))


def _all_about(task: Task) -> str:
    from league.runs.bench import references

    known = references.of(task)
    sides = [{"side": team, "robots: numbers seen: numbers acted with": roster} for team, roster in task.sides.items()]
    lines = [f"{task.name}: {task.about}. Arena {task.arena}, configuration {task.config_hash}.", render(sides)]
    if not task.exact:
        rows = [
            {"reference": each.name, "side": each.team or "both", "kind": each.kind, "about": each.provenance}
            for each in known.references
        ]
        lines.append(render(rows, (Column("reference", no_wrap=True), "side", "kind", "about")))
    if task.lacks:
        lines.append(f"Missing: {task.lacks}.")
    if task.tracks:
        lines.append(f"Tracks: {'; '.join(f'{name} ({TRACKS[name]})' for name in task.tracks)}.")
    wanted = "FILE" if task.alike else " ".join(f"{team}=FILE" for team in task.teams)
    taken = "It takes files of `league export`, no programs. " if task.exact else ""
    lines.append(f"What robots see and do: {task.arena_command}")
    lines.append(f"{taken}Enter: league bench {task.name} --entry {wanted}")
    return "\n\n".join(lines)


def _result(task: Task, content: dict[str, Any]) -> str:
    """Describe an entry's metrics."""
    lines, found = [f"Entry {content['name']} of {task.name}:"], content["metrics"]
    names = {each["name"]: f"{each['name']} ({', '.join(each['files'])})" for each in content["policies"]}
    if task.exact:
        return "\n".join(
            f"{names[each['name']]}: exact exploitability {each['exploitability']:.6f}, NashConv"
            f" {each['nash_conv']:.6f}."
            for each in found["policies"]
        )
    for each in found["policies"]:
        name, rating, worst = names[each["name"]], each["rating"], each["worst"]
        lines.append(
            f"{name}: {rating['elo']:.0f} Elo ({rating['low']:.0f} to {rating['high']:.0f}), where the mean of"
            f" the references is 1000; worst {_percent(worst)} against {worst['against']};"
            f" {100 * each['voids']:.2f} % void{'' if each['ranked'] else NO_RANK}."
        )
        rows = [{"against": row["against"], "score": _percent(row), "games": row["games"]} for row in each["scores"]]
        lines.append(render(rows))
    if content["curve"]:
        reached = found["seconds_to_75"]
        after = "is not reached" if reached is None else f"is reached after {reached:g} s of training"
        lines.append(f"75 % against the references of the middle stage {after}.")
    for each in found["exploitability"] or []:
        name, steps = names[each["policy"]], each["attacker_steps"]
        lines.append(f"An attacker of {name} scores {_percent(each)} after {steps:,} steps.")
    if content["trial"]:
        lines.append(
            f"This is a trial, no record: a record has {GAMES:,} games of each pair, all references and the seed of"
            " records."
        )
    return "\n\n".join(lines)


def _percent(score: dict[str, Any]) -> str:
    if score["score"] is None:
        return "all void"
    return f"{100 * score['score']:.1f} % ({100 * score['low']:.1f}-{100 * score['high']:.1f})"
