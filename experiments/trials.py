"""Trainings of presets or configuration files for a given time, and what they leave: policy files and learning curves.

    python -m experiments.trials soccer-1v1 --seeds 1 2 --within 1420 --store runs/trials --out runs/out
    python -m experiments.trials mine.toml --within 300 --store runs/trials --out runs/out -- --training.worlds 512

Each run is `league run` as typed, with a store of its own, `STORE/NAME-SEED`, until it ends or `--within` seconds are
over; NAME is that of the preset, or of the file without its ending. The same command goes on with leagues that were
stopped. A run leaves in OUT, once it has stopped, and with `--every` each so many seconds before, as it is then:

- `LEAGUE/SEED/PLAYER.safetensors` and `PLAYER-0.safetensors`, every player as it was last saved and at first; of a
  curriculum every stage is a league, `NAME.STAGE`. `experiments/cross_play.py OUT/LEAGUE` plays them;
- `NAME-SEED.json` with the command, commit and machine, and the seconds at which each stage began, learnt and ended
  (below 0 for those of an earlier command); of each league the ratings of its own matches against the first opponents
  (of a team alone its successes) with 95 % intervals, and learning curves, the means of at most `PARTS` parts.
"""

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import product
from pathlib import Path
from queue import SimpleQueue
from threading import Event
from typing import Any

from league.system.environment import prepare

prepare()  # before jax reads the environment

import numpy as np

from league.commands.cli import guarded
from league.config import experiment
from league.config.presets import PRESETS
from league.queries.query import Open
from league.runs.sweeps.sweep_work import device_of
from league.scheduling.progress_metrics import score_against_initial
from league.snapshots import policy_file
from league.state.league_state import LeagueState
from scripts.record import make_parser, run_info, split_arguments, write
from storage.errors import StorageError
from storage.records import CurvePoint
from storage.store import Store

PARTS = 60
VALUES = ("score", "reward", "kl", "entropy", "explained_variance")
"""Figures of a learning curve that a result has."""


def run_within(
    command: Sequence[str], log: Path, seconds: float, done: Callable[[], bool] = lambda: False,
    variables: Mapping[str, str] | None = None,
) -> float:  # fmt: skip
    """Run a league until it ends, `done` says so or `seconds` are over, and return when it began (epoch seconds).

    Its output is added to `log`; `variables` are of its environment, beside this process's own. Exits with the output
    if the league fails.
    """
    began = time.time()
    with log.open("a") as out:
        environment = {**os.environ, **(variables or {})}
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env=environment)
        while process.poll() is None and time.time() - began < seconds and not done():
            time.sleep(1.0)
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            process.wait()
    if process.returncode not in (0, 130):
        sys.exit(f"the league failed:\n{log.read_text()}")
    return began


def stage_times(where: Path, began: float) -> dict[str, dict[str, float | None]]:
    """Return by stage when it `began`, when its `first_step` was learnt and when it `ended`, in seconds from `began`.

    None for what has not happened; without entries for stages that have not begun and for a league without stages.
    """
    found = {}
    with Store.open(where) as store:
        leagues = {league.name: league for league in store.leagues()}
        whole = min(leagues, key=len, default="")
        for stage in experiment.loads(leagues[whole].config).stages if leagues else ():
            if (name := f"{whole}.{stage.name}") not in leagues:
                continue
            state = LeagueState.of(store, name)
            learnt = [s.created - s.seconds for s in state.snapshots if s.player and s.iteration > 0]
            last = max([state.played, *(c.created for c in state.checkpoints.values())])
            times = {"began": leagues[name].created, "first_step": min(learnt, default=0.0), "ended": last}
            found[stage.name] = {what: round(at - began, 1) if at else None for what, at in times.items()}
    return found


def curve(points: Sequence[CurvePoint]) -> Iterator[dict[str, float]]:
    """Yield the means of a learning curve over at most PARTS parts, each with the steps and seconds at its end."""
    for part in np.array_split(np.arange(len(points)), min(PARTS, len(points)) or 1):
        if not len(part):
            return
        end, means = points[part[-1]], {}
        for name in VALUES:
            if values := [points[k].values[name] for k in part if name in points[k].values]:
                means[name] = round(float(np.mean(values)), 4)
        yield {"iteration": end.iteration, "steps": end.step, "seconds": round(end.seconds, 1), **means}


def rated(state: LeagueState, player: str) -> Iterator[dict[str, Any]]:
    """Yield the snapshots of a player that its league has rated, oldest first, with their scores."""
    ladder = state.ladder
    for snapshot in state.history(player):
        if snapshot.name not in ladder.payoff.names:
            continue
        alone = ladder.success(snapshot.name) if state.one_team else None
        found = alone or score_against_initial(ladder, snapshot, state.snapshots, state.players)
        if found and found.games:
            told = {"score": round(found.score, 4), "low": round(found.low, 4), "high": round(found.high, 4)}
            about = {"snapshot": snapshot.name, "steps": snapshot.step, "seconds": round(snapshot.seconds, 1)}
            yield {**about, **told, "n": found.games}


def last_saved(opened: Open, player: str) -> policy_file.Policy | None:
    """Return a player that has learnt on since its newest snapshot; None if it has not, or its learner is its own."""
    try:
        return policy_file.export_checkpoint(opened, player)
    except StorageError as error:  # training is over, and its newest snapshot is there
        print(error, flush=True)
        return None


def export(store: Store, name: str, folder: Path) -> dict[str, Any]:
    """Write the newest and the first policy of every player of a league into a folder; return what JSON has of it."""
    opened, state, found = Open(store, name), LeagueState.of(store, name), {}
    for player in state.players:
        history = state.history(player.name)
        folder.mkdir(parents=True, exist_ok=True)
        newest = last_saved(opened, player.name) or policy_file.export(opened, history[-1].name, [])
        for ending, policy in (("", newest), ("-0", policy_file.export(opened, history[0].name, []))):
            (folder / f"{player.name}{ending}.safetensors").write_bytes(policy.to_bytes())
        found[player.name] = {
            "newest": newest.about["name"], "steps": newest.about["steps"], "sha256": newest.about["digest"],
            "rated": list(rated(state, player.name)), "curve": list(curve(store.curves(name, player.name))),
        }  # fmt: skip
    return found


def name_of(run: str) -> str:
    """Return the name of a preset, or of a file without its ending."""
    return run if run in PRESETS else Path(run).stem


def leave(args: argparse.Namespace, name: str, seed: int, command: Sequence[str], began: float) -> dict[str, Any]:
    """Write what a run has by now, and return its JSON. Raises StorageError before its store exists."""
    where, took, leagues = store_of(args, name, seed), time.time() - began, {}
    with Store.open(where) as store:
        for each in store.leagues():
            if store.players(each.name):
                leagues[each.name] = export(store, each.name, args.out / each.name / str(seed))
    result = {
        "run": " ".join(command[2:]).replace(str(where), "STORE"), "seed": seed, "took": round(took, 1),
        "stages": stage_times(where, began), "leagues": leagues,
    }  # fmt: skip
    print(f"{name}, seed {seed}: {took:.0f} s; {told(leagues)}", flush=True)
    write(result, result_of(args, name, seed))
    return result


def store_of(args: argparse.Namespace, name: str, seed: int) -> Path:
    """Return the folder of a run's store."""
    return args.store / f"{name}-{seed}"


def result_of(args: argparse.Namespace, name: str, seed: int) -> Path:
    """Return the file of a run's JSON."""
    return args.out / f"{name}-{seed}.json"


def trial(
    args: argparse.Namespace, run: str, seed: int, stop: Callable[[], bool], variables: Mapping[str, str]
) -> tuple[Path, dict[str, Any]]:
    """Train one run from one seed until `stop` says so; write what it leaves, and return its JSON with the path."""
    name, start = name_of(run), ["--preset", run] if run in PRESETS else [run]
    where, began = store_of(args, name, seed), time.time()
    where.mkdir(parents=True, exist_ok=True)
    command = [
        sys.executable, "-m", "league", "run", *start, "--store", str(where), "--league", name, "--seed", str(seed),
        "--budget.rating_time", "0s", *args.flags,
    ]  # fmt: skip
    due = began + args.every

    def stopped() -> bool:
        nonlocal due
        if args.every and time.time() > due:
            with suppress(StorageError):  # nothing has begun yet
                leave(args, name, seed, command, began)
            due = time.time() + args.every
        return stop()

    run_within(command, args.store / f"{name}-{seed}.txt", args.within, stopped, variables)
    return result_of(args, name, seed), leave(args, name, seed, command, began)


def told(leagues: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the newest rated snapshot of each player of the newest league as a line."""
    if not leagues:
        return "no league has begun"
    name, players = list(leagues.items())[-1]
    newest = {player: found["rated"][-1] if found["rated"] else None for player, found in players.items()}
    parts = [f"{r['snapshot']} {r['score']:.1%} of {r['n']}" if r else f"{p} not rated" for p, r in newest.items()]
    return f"{name}: {', '.join(parts)}"


def parsed(argv: Sequence[str]) -> argparse.Namespace:
    """Return the arguments. Exits with code 2 for what cannot be."""
    parser = make_parser(__doc__)
    parser.set_defaults(out=Path("runs/out"))
    parser.add_argument("runs", nargs="+", metavar="RUN", help="a preset, or a file of settings (.toml)")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1], metavar="SEED")
    parser.add_argument("--within", type=float, default=540.0, help="seconds of a run at most, from its command")
    parser.add_argument("--every", type=float, default=0.0, help="seconds after which it leaves what it has (0: never)")
    parser.add_argument("--jobs", type=int, default=1, help="runs at once; several GPUs are shared out")
    parser.add_argument("--store", type=Path, required=True, help="the folder for the leagues' stores")
    own, further = split_arguments(list(argv))
    args = parser.parse_args(own, argparse.Namespace(flags=further))
    for run in args.runs:
        if run not in PRESETS and not Path(run).is_file():
            parser.error(f"{run} is neither a preset nor a file; presets: {', '.join(sorted(PRESETS))}")
    names = [name_of(run) for run in args.runs]
    if len(set(names)) < len(names) or len(set(args.seeds)) < len(args.seeds):
        parser.error(
            f"{', '.join(names)} with seeds {', '.join(map(str, args.seeds))}: each once, as they share a store"
        )
    if not args.within > 0:
        parser.error(f"--within is {args.within}: give seconds above 0")
    if not args.every >= 0:
        parser.error(f"--every is {args.every}: give seconds, or 0")
    if args.jobs < 1:
        parser.error(f"--jobs is {args.jobs}: give 1 or more")
    return args


def main(argv: Sequence[str] | None = None) -> int:
    """Train every run from every seed, `--jobs` at once; return 0, or 130 if SIGINT or SIGTERM stopped it.

    Leagues that are stopped so leave what they have.
    """
    args = parsed(sys.argv[1:] if argv is None else argv)
    free, stopped = SimpleQueue[int](), Event()
    for slot in range(args.jobs):
        free.put(slot)

    def train(job: tuple[str, int]) -> tuple[Path, dict[str, Any]] | None:
        slot = free.get()
        try:
            return None if stopped.is_set() else trial(args, *job, stopped.is_set, device_of(slot, args.jobs))
        finally:
            free.put(slot)

    def stop(number: int, frame: object) -> None:
        stopped.set()

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with ThreadPoolExecutor(args.jobs) as pool:
            results = [each for each in pool.map(train, product(args.runs, args.seeds)) if each]
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    about = run_info(args.commit)  # only now, since it takes a GPU's memory
    for path, result in results:
        write({**result, **about}, path)
    return 130 if stopped.is_set() else 0


if __name__ == "__main__":
    sys.exit(guarded(main))
