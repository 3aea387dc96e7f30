"""`league stop`, `league status`, `league init`, `league arenas`, `league check`."""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from dashboards.tables import Column, render
from league.options import Where, parse
from storage.errors import StorageError

WAIT = 90.0  # seconds that `league stop` waits for workers to finish their iteration


def stop(args: list[str]) -> int:
    """Stop a running league."""
    options = parse(Where, args, "stop", "Stop a running league; what its workers do is finished and kept.")
    with options.open() as opened:
        store, league = opened.store, opened.league
        if not store.workers(league, 10):
            print(f"League {league} is not running.")
            return 0
        store.ask_stop(league)
        deadline = time.monotonic() + WAIT
        while store.workers(league, 10) and time.monotonic() < deadline:
            time.sleep(0.3)
        left = store.workers(league, 10)
    if left:
        raise StorageError(f"{len(left)} processes of league {league} still work after {WAIT:.0f} s: {left[0].id}")
    print(f"League {league} has stopped.")
    return 0


def status(args: list[str]) -> int:
    """Tell what runs and what waits."""
    options = parse(Where, args, "status", "What runs, who learns, which jobs wait or failed.")
    with options.open() as opened:
        store, league = opened.store, opened.league
        workers, jobs, now = store.workers(league, 30), store.jobs(league), store.now()
        newest = max(store.checkpoints(league), key=lambda c: c.iteration, default=None)
        counts = {state: sum(j.state == state for j in jobs) for state in ("queued", "leased", "done", "failed")}
        at = f"iteration {newest.iteration}, {newest.step:,} steps, {newest.seconds:.0f} s" if newest else "not begun"
        print(f"League {league}: {at}; jobs " + ", ".join(f"{n} {state}" for state, n in counts.items()))
        rows = [
            {
                "worker": w.id, "doing": w.status.get("doing", ""), "learners": "+".join(w.status.get("learners", [])),
                "iteration": w.status.get("iteration"), "steps/s": w.status.get("steps_per_second"),
                "seen s ago": round(now - w.seen, 1),
            }
            for w in workers
        ]  # fmt: skip
        print(render(rows, ["worker", "doing", "learners", "iteration", Column("steps/s", decimals=0), "seen s ago"]))
        for job in jobs:
            if job.state == "failed":
                told = (job.error or "").strip()
                told = told if "--debug" in sys.argv else told.partition("\n")[0] + " (--debug shows where)"
                print(f"\nfailed: {job.key} (attempt {job.attempt}): {told}")
    return 0


@dataclass(frozen=True)
class InitOptions:
    """Where to write, and what."""

    folder: Annotated[Path, tyro.conf.Positional] = Path()
    """Folder for league.toml."""
    preset: str = "quickstart"
    """Settings to start from: quickstart, duel or paper."""


def init(args: list[str]) -> int:
    """Write a commented league.toml."""
    options = parse(InitOptions, args, "init", "Write a commented league.toml with every setting.")
    from league import config as configuration
    from league.settings import ConfigError

    text = configuration.dumps(configuration.preset(options.preset))
    path = options.folder / "league.toml"
    try:
        options.folder.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise ConfigError((), f"{path} exists already: move it away, or give another folder") from None
    except OSError as error:
        raise ConfigError((), f"cannot write {path}: {error.strerror}") from None
    print(f"Wrote {path}. `league run {path}` runs it.")
    return 0


@dataclass(frozen=True)
class ArenasOptions:
    """No options."""


def arenas(args: list[str]) -> int:
    """List the arenas."""
    parse(ArenasOptions, args, "arenas", "The arenas and what they look like to a policy.")
    from arenas import known

    rows = []
    for name, settings in known().items():
        arena = settings.build(engine="c", threads=1)
        timing = arena.timing
        rows.append({
            "arena": name, "teams": " vs ".join(t.name for t in arena.teams), "roster": arena.teams[0].roster,
            "episode": f"{timing.episode:g} s", "decides": f"{1 / (timing.control_interval * timing.hold):g} Hz",
            "scripts": ", ".join(arena.scripts()),
        })  # fmt: skip
    print(render(rows))
    print("\nYour own needs no registration: league check my/duel.py:duel")
    return 0


@dataclass(frozen=True)
class CheckOptions:
    """What to examine, and with which engine."""

    name: Annotated[str, tyro.conf.Positional]
    """An arena's name, or file.py:name for your own."""
    engine: Literal["auto", "c", "jax", "warp"] = "auto"
    """Physics to examine it with."""


def check(args: list[str]) -> int:
    """Examine an arena against the contract: exit code 0 if it keeps it, 1 if not."""
    options = parse(CheckOptions, args, "check", "Examine an arena against the contract that the league relies on.")
    from arenas import settings
    from arenas.check import check_arena

    chosen = settings(options.name)
    found = check_arena(chosen.build(engine=options.engine, worlds=8), chosen)
    for name, ok, detail in found:
        print(f"{'ok    ' if ok else 'FAILED'}  {name}{': ' + detail if detail else ''}")
    return 0 if all(ok for _, ok, _ in found) else 1
