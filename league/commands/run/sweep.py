"""`league sweep`: a grid of settings and seeds, each run a league of one store."""

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from dashboards.tables import Column, render
from dashboards.text import clock
from league.commands.options import STORE, parse, positional
from league.config.schema import ConfigError
from league.runs.sweeps import sweep_file
from league.runs.sweeps.run_state import run_state
from league.runs.sweeps.sweep_file import Sweep, SweepRun, cell_text
from league.runs.sweeps.sweep_work import Outcome, SweepWork
from league.system.exit_codes import DONE, NO
from storage.database.urls import display_location
from storage.errors import NotAStore
from storage.store import Store

COLUMNS = (Column("league", no_wrap=True), Column("state", no_wrap=True), "cell", "seed")


@dataclass(frozen=True)
class SweepOptions:
    """The sweep's file, the store, and how many runs there are at a time."""

    file: str = positional()
    """A TOML file: settings as in league.toml, and the tables [sweep] and [sweep.grid]."""
    store: str = STORE
    """The store of all runs: a folder, or a URL such as sqlite:///runs/league.db or postgresql://host/league."""
    blobs: str | None = None
    """The place where the store keeps policies and recordings; the same as storage.blobs."""
    parallel: int | None = field(default=None, metadata={"low": 1, "high": 64})
    """Leagues that run at the same time (none: sweep.parallel); where there are several GPUs each has its own."""
    dry_run: bool = field(default=False, metadata={"flag": "dry_run"})
    """List the runs and what is left of them; run none."""
    format: Literal["table", "json", "csv"] = "table"
    """Of --dry-run: table for people, json or csv for programs."""


def sweep(args: list[str]) -> int:
    """Work off a sweep."""
    what = (
        "Run every combination of a grid of settings, for every seed, as leagues of one store. Finished runs are"
        " skipped, stopped ones go on, and a run that fails does not stop the others."
    )
    options = parse(SweepOptions, args, "sweep", what)
    found = sweep_file.read(Path(options.file))
    if options.blobs is not None:
        found = _with_blobs(found, options.blobs)
    parallel = options.parallel or found.settings.parallel
    if options.dry_run:
        print(_listing(found, options))
        return DONE
    return _search(found, options.store, parallel) if found.ranges else _grid(found, options.store, parallel)


def _with_blobs(found: Sweep, blobs: str) -> Sweep:
    storage = found.base.get("storage")
    own = dict(storage) if isinstance(storage, dict) else {}
    if own.get("blobs", blobs) != blobs:
        raise ConfigError(("blobs",), f"--blobs {blobs} contradicts storage.blobs of {found.source}: give one of them")
    return replace(found, base={**found.base, "storage": {**own, "blobs": blobs}})


def _listing(found: Sweep, options: SweepOptions) -> str:
    if found.ranges:
        ranges = ", ".join(f"{key} from {each.low:g} to {each.high:g}" for key, each in found.ranges.items())
        searched = f"{found.settings.trials} points of {ranges}"
        more = f", of each of {', '.join(found.grid)}" if found.grid else ""
        return f"Sweep {found.name} searches {searched}{more}, with {len(found.settings.seeds)} runs each."
    runs = found.runs()
    states = _states(runs, options.store)
    rows = [
        {"league": run.name, "state": state, "seed": run.seed, **run.cell}
        for run, state in zip(runs, states, strict=True)
    ]
    if options.format != "table":
        return render(rows, (), options.format)
    shown = [{**row, "cell": cell_text(run.cell)} for row, run in zip(rows, runs, strict=True)]
    count = {state: states.count(state) for state in dict.fromkeys(states)}
    return f"{render(shown, COLUMNS)}\n\n{len(runs)} runs: {', '.join(f'{n} {state}' for state, n in count.items())}."


def _states(runs: list[SweepRun], where: str) -> list[str]:
    try:
        with Store.open(where, blobs=runs[0].config.storage.blobs) as store:
            return [run_state(store, run.config) for run in runs]
    except NotAStore:
        return ["waits" for _ in runs]


def _grid(found: Sweep, where: str, parallel: int) -> int:
    runs, place = found.runs(), display_location(where)
    _say(f"Sweep {found.name}: {len(runs)} runs, {parallel} at a time; stored in {place}. Ctrl-C stops them.")
    return _end(found, where, SweepWork(where, parallel, _say).work_off(runs), len(runs))


def _search(found: Sweep, where: str, parallel: int) -> int:
    from league.runs.sweeps.search import Search

    search, total = Search(found, where), Outcome()
    seeds, place = len(found.settings.seeds), display_location(where)
    _say(f"Sweep {found.name} searches {found.settings.trials} points, {seeds} runs each; stored in {place}.")
    for asked in search.rounds(parallel):
        done = SweepWork(where, parallel, _say).work_off([run for _, runs in asked for run in runs])
        total.finished += done.finished
        total.failed |= done.failed
        total.elsewhere += done.elsewhere
        for trial, runs in asked:
            value = search.tell(trial, runs)
            told = "not known" if value is None else f"{value:.4g}{search.too_early(runs)}"
            _say(f"{cell_text(runs[0].cell)}: {found.settings.objective} {told}")
    if best := search.best():
        points, merit = len(search.study.trials), found.settings.objective
        _say(f"Best of {points} points: {cell_text(best[0])}, {merit} {best[1]:.4g}.")
    return _end(found, where, total, len(total.finished) + len(total.failed) + len(total.elsewhere))


def _end(found: Sweep, where: str, outcome: Outcome, count: int) -> int:
    parts = [f"{len(outcome.finished)} of {count} runs have finished" if count else "nothing was left to run"]
    parts += [f"{len(outcome.elsewhere)} are run by other processes"] if outcome.elsewhere else []
    parts += [f"{len(outcome.failed)} failed, and the same command tries them again"] if outcome.failed else []
    _say(f"{'; '.join(parts)}. `league compare --sweep {found.name} --store {display_location(where)}` compares them.")
    return NO if outcome.failed else DONE


_BEGAN = time.monotonic()


def _say(text: str) -> None:
    print(f"{clock(time.monotonic() - _BEGAN)}  {text}", flush=True)
