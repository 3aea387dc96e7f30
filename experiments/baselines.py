"""Baselines of Robot League Bench: a league for each task, method and seed, and its final policies as entry files.

    python -m experiments.baselines --tasks t5-pursuit-v1 --steps 50_000_000 --worlds 4096 --jobs 3 \\
        --store runs/baselines --out runs/entries

A league plays in the task's frozen arena, with the learner of the preset of that game (`STARTS`), and ends when each
player has had `--steps` decisions, rounded up to whole iterations. Its processes are those of `league run`, and
`league run OUT/TASK/METHOD/SEED/league.toml --store STORE` does the same. Beside that file lie `SIDE.safetensors`, the
newest policy of each side's main player, and `result.json`, with the decisions of every player. What is there is
skipped, and leagues that were stopped or killed go on when the same command is given again. With `--enter FOLDER`
nothing is trained: `league bench` measures what `--out` has, an entry for each task and method, into that folder.

Methods differ by opponents alone, but for the last three:

- `latest`, `uniform`, `pfsp`: HAPPO against the newest opponents, a uniform history, prioritised fictitious self-play;
- `alphastar`: a main player, a main exploiter and a league exploiter for each side, as in the preset `alphastar`; each
  has `--steps` decisions, so that the population has three times as many;
- `psro`: the Nash mixture of the payoff table, for which training waits. Players continue instead of starting afresh,
  and the entry is the newest policy, not the mixture. In exact tasks the table counts chips instead of hands won;
- `shared`: HAPPO against the newest opponents; equal robots of a team share one actor;
- `mappo`: the same, and all robots of a team learn from the same advantage;
- `magnet`: the newest opponents and a magnet, that of the preset where it has one.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import groupby, product
from math import ceil
from pathlib import Path
from typing import Any

from league.system.environment import prepare

prepare()  # before jax reads the environment

from league.commands.cli import guarded
from league.config import experiment
from league.config.experiment import Config, change, dumps
from league.config.presets import preset
from league.config.schema import ConfigError
from league.config.sections import Budget, PlayerSettings
from league.queries.query import Open
from league.runs.bench import tasks
from league.runs.bench.tasks import GAMES, Task
from league.runs.sweeps.run_state import run_state
from league.runs.sweeps.sweep_file import SweepRun
from league.runs.sweeps.sweep_work import SweepWork
from league.snapshots import policy_file
from league.system.packages.versions import versions
from matchmaking.opponents import Opponents
from matchmaking.roles import MAIN, Role
from scripts.record import command_line, commit, make_parser
from storage.store import Store

METHODS: Mapping[str, Opponents] = {
    "latest": Opponents("latest"),
    "uniform": Opponents("uniform"),
    "pfsp": Opponents("pfsp"),
    "alphastar": Opponents("alphastar"),
    "psro": Opponents("nash", await_matches=True),
    "shared": Opponents("latest"),
    "mappo": Opponents("latest"),
    "magnet": Opponents("latest"),
}
ABOUT: Mapping[str, str] = {
    "latest": "HAPPO against the newest opponents",
    "uniform": "HAPPO against a uniform history",
    "pfsp": "HAPPO by prioritised fictitious self-play",
    "alphastar": "AlphaStar's league, its main players",
    "psro": "PSRO whose players continue, their newest policies",
    "shared": "HAPPO against the newest opponents, one actor for equal robots",
    "mappo": "MAPPO against the newest opponents, one actor for equal robots",
    "magnet": "HAPPO against the newest opponents with a magnet",
}
MAGNET = 0.05
"""Weight of the magnet where the preset has none, as in experiments/attackers.py."""
FADE = 0.4
"""Share of the steps over which the dense reward fades, where the preset counts on more steps."""
TURNS = 2
"""Turns, each with new opponents, between two snapshots of a main player, unless an iteration is longer."""

AGES = {"early": 0.1, "middle": 0.4}
"""Shares of the steps of the earlier policies that `--ages` exports too, as references need them."""
PATIENCE = 5.0
"""Seconds until leagues that another process runs are looked at again."""


@dataclass(frozen=True)
class Start:
    """Settings that all methods of a task share: the preset whose learner and training they take, and differences.

    `after` are policies that come with the package, from which players start. With `matches` the settings are those of
    the preset's last stage.
    """

    preset: str
    learner: Mapping[str, Any] = field(default_factory=dict)
    after: tuple[str, ...] = ()
    matches: bool = False

    def settings(self) -> Config:
        """Return the settings of the preset, or of its last stage."""
        config = preset(self.preset)
        return experiment.stage(config, len(config.stages) - 1) if self.matches else config


SCORING = {"lr": 3e-4, "desired_kl": 0.01, "gamma": 0.997}  # as in the preset's stages in which robots learn to score
STARTS: Mapping[str, Start] = {
    "t0-kuhn-poker-v1": Start("kuhn-poker"),
    "t0-leduc-poker-v1": Start("leduc-poker"),
    "t0-dark-hex-3-v1": Start("leduc-poker"),  # dark hex has no preset of its own
    "t1-sumo-rovers-v1": Start("quickstart", {"share_actors": False}),  # by the methods `shared` and `mappo` alone
    "t2-sumo-unlike-v1": Start("sumo-by-team", after=("anymals-sumo", "leatherbacks-sumo"), matches=True),
    "t3-soccer-1v1-v1": Start("soccer-1v1", SCORING, ("anymal-score", "leatherback-score-preset")),
    "t4-galaga-1v1-v1": Start("galaga-1v1", after=("minitank-galaga", "crazyflie-galaga")),
    "t5-pursuit-v1": Start("galaga-1v1", {"share_actors": True}),  # pursuit has no preset of its own
    "t6-sumo-ants-v1": Start("sumo-ants"),
}
"""Tasks with baselines. In T4 to T6 the references learnt with these settings too."""


@dataclass(frozen=True)
class Entry:
    """A league of a task, a method and a seed, and the folder of what it leaves."""

    task: Task
    method: str
    run: SweepRun
    folder: Path

    @property
    def result(self) -> Path:
        """The file that is written last."""
        return self.folder / "result.json"


def config_of(task: Task, method: str, seed: int, args: argparse.Namespace) -> Config:
    """Return the settings of a league. Raises ConfigError or ValueError, one line, for a number that cannot be."""
    start, config, each = STARTS[task.name], task.config(), max(1, args.steps // args.snapshots)
    base = start.settings()
    learner = replace(base.learner, **start.learner)
    if method == "magnet":
        learner = replace(learner, magnet_coef=learner.magnet_coef or MAGNET)
    else:
        learner = replace(learner, magnet_coef=0.0, magnet_updates=0)
    if method in ("shared", "mappo"):
        learner = replace(learner, method="mappo" if method == "mappo" else learner.method, share_actors=True)
    iterations = ceil(each / (TURNS * args.worlds * base.training.rollout_length))
    training = replace(
        base.training, worlds=args.worlds, opponents=METHODS[method], record_every=0,
        iterations_per_turn=min(base.training.iterations_per_turn, iterations),
        shaping_steps=min(base.training.shaping_duration, round(FADE * args.steps)), shaping_until=None,
    )  # fmt: skip
    # A milestone would end a turn by the clock, and opponents of the next turn would not be those of another run.
    rating = replace(
        config.rating, share=0.0, scripts=(), trained=False, record=False, episodes_per_pair=args.episodes,
        milestones=(),
    )  # fmt: skip
    if method == "psro" and task.exact:
        config = change(config, {("arena", "rules", "score"): "chips"})
    threads = max(1, len(os.sched_getaffinity(0)) // args.jobs)
    return replace(
        config, league=f"{task.name.rpartition('-')[0]}.{method}.s{seed}", seed=seed, engine=args.engine,
        players=_population(task) if method == "alphastar" else (), roles=_roles(method, each), training=training,
        learner=learner, rating=rating, budget=Budget(steps=args.steps, rating_time="0s"), after=start.after,
        workers=replace(config.workers, match=int(method == "psro"), threads=threads),
    )  # fmt: skip


def _population(task: Task) -> tuple[PlayerSettings, ...]:
    """Return AlphaStar's players, three for each side, in the groups of the preset `alphastar`."""
    kinds = dict.fromkeys((p.name.removeprefix(p.team), p.role, p.group) for p in preset("alphastar").players)
    return tuple(PlayerSettings(team, team + end, role, group) for end, role, group in kinds for team in task.sides)


def _roles(method: str, each: int) -> tuple[Role, ...]:
    """Return the roles: main players are frozen after every `each` steps, exploiters less often, as in the preset."""
    if method != "alphastar":
        return (Role(MAIN.name, timeout=each),)
    timeouts = {role.name: role.timeout or 1 for role in preset("alphastar").roles}
    return tuple(Role(name, timeout=each * steps // timeouts[MAIN.name]) for name, steps in timeouts.items())


def entry_of(task: Task, method: str, seed: int, args: argparse.Namespace) -> Entry:
    """Return a league with its folder, in which its settings are written if it has to learn."""
    config, folder = config_of(task, method, seed, args), args.out / task.name / method / str(seed)
    entry = Entry(task, method, SweepRun({}, seed, config), folder)
    if not args.enter and not entry.result.exists():
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "league.toml").write_text(dumps(config, comments=False), "utf-8")
    return entry


def export(store: Store, entry: Entry, args: argparse.Namespace) -> None:
    """Write the newest policies of a league that has ended, and its result.

    Raises ConfigError if they did not learn in the frozen arena.
    """
    league, sides, rows, taken = entry.run.name, list(entry.task.sides), [], {}
    opened, checkpoints = Open(store, league), store.newest_checkpoints(league)
    for player in store.players(league):
        done, team, history = checkpoints[player.name], sides[player.team], store.snapshots(league, player.name)
        rows.append({
            "player": player.name, "team": team, "role": player.role, "decisions": done.step, "paused": player.paused,
            "iterations": done.iteration, "training_seconds": round(done.seconds, 1), "snapshots": len(history),
        })  # fmt: skip
        if player.role != MAIN.name:
            continue
        newest = max(history, key=lambda snapshot: snapshot.iteration)
        files = {team: newest}
        for age, share in AGES.items() if args.ages else ():
            files[f"{team}-{age}"] = min(history, key=lambda each: abs(each.step - share * args.steps))
        frozen = entry.run.config.arena == entry.task.config().arena
        if newest.arena is None or (frozen and newest.arena.config_hash != entry.task.config_hash):
            raise ConfigError((), f"{newest.name} of {league} did not learn in the arena of {entry.task.name}")
        for file, snapshot in files.items():
            write_whole(entry.folder / f"{file}.safetensors", policy_file.export(opened, snapshot.name).to_bytes())
        taken[team] = {"snapshot": newest.name, "decisions": newest.step, "engine": newest.arena.engine}
    result = {
        "task": entry.task.name, "config_hash": entry.task.config_hash, "method": entry.method, "seed": entry.run.seed,
        "steps": args.steps, "worlds": args.worlds, "policies": taken,
        "population_decisions": {t: sum(row["decisions"] for row in rows if row["team"] == t) for t in sides},
        "match_decisions": sum(match.steps for match in store.matches(league)), "players": rows,
        "command": command_line(), "commit": args.commit or commit(), "versions": versions(),
    }  # fmt: skip
    write_whole(entry.result, f"{json.dumps(result, indent=1)}\n".encode())


def write_whole(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    part = path.with_name(f"{path.name}.part")
    part.write_bytes(data)
    part.replace(path)


def export_finished(entries: Sequence[Entry], args: argparse.Namespace) -> None:
    """Export every league that has had its budget and is not exported yet."""
    with Store.open(args.store, create=True) as store:
        for entry in entries:
            if not entry.result.exists() and run_state(store, entry.run.config) == "finished":
                export(store, entry, args)
                print(f"{entry.run.name} is in {entry.folder}", flush=True)


def told(entries: Sequence[Entry]) -> Iterator[str]:
    """Yield a line for each league that was exported: decisions of main players and of all players, by side."""
    for entry in entries:
        if entry.result.exists():
            found = json.loads(entry.result.read_text("utf-8"))
            mains = {side: f"{each['decisions']:,}" for side, each in found["policies"].items()}
            everyone = {side: f"{steps:,}" for side, steps in found["population_decisions"].items()}
            yield f"{entry.run.name}: decisions of main players {mains}, of all {everyone}"


def bench_command(task: Task, method: str, entries: Sequence[Entry], args: argparse.Namespace) -> list[str]:
    """Return the command that enters the exported policies of a method, or nothing where that has been done."""
    done, out = [entry for entry in entries if entry.result.exists()], args.enter / f"{task.name}-{method}.json"
    if not done or out.exists():
        return []
    results = [json.loads(entry.result.read_text("utf-8")) for entry in done]
    own = max(each["decisions"] for result in results for each in result["policies"].values())
    everyone = max(steps for result in results for steps in result["population_decisions"].values())
    seeds = ", ".join(str(result["seed"]) for result in results)
    worlds = " and ".join(map(str, sorted({result["worlds"] for result in results})))
    population = f", {everyone:,} of all players of a side" if everyone > own else ""
    files = [
        f"{'' if task.alike else f'{side}='}{entry.folder}/{side}.safetensors" for side in task.teams for entry in done
    ]
    begun = f", begun as {' and '.join(after)}" if (after := STARTS[task.name].after) else ""
    games = [] if task.exact else ["--games", str(args.games)]
    track = ["--track", args.track] if args.track else []
    return [
        sys.executable, "-m", "league", "bench", task.name, "--entry", *files, "--name", method, "--about",
        f"{ABOUT[method]}{begun}: {own:,} decisions{population}; {worlds} worlds; seeds {seeds}"
        " (experiments/baselines.py)",
        "--out", str(out), *games, *track,
    ]  # fmt: skip


def enter(entries: Sequence[Entry], args: argparse.Namespace) -> int:
    """Measure what was exported, `--jobs` methods at once; return the number of commands that failed."""
    args.enter.mkdir(parents=True, exist_ok=True)
    groups = groupby(entries, key=lambda entry: (entry.task, entry.method))
    asked = [command for at, group in groups if (command := bench_command(*at, [*group], args))]

    def run(command: list[str]) -> int:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        lines = [line for line in (done.stdout if done.returncode == 0 else done.stderr).splitlines() if line.strip()]
        print(f"{command[command.index('--out') + 1]}: {lines[-1] if lines else done.returncode}", flush=True)
        return done.returncode

    with ThreadPoolExecutor(args.jobs) as pool:
        return sum(code != 0 for code in pool.map(run, asked))


def parsed(argv: Sequence[str] | None) -> argparse.Namespace:
    """Return the arguments. Exits with code 2 for what cannot be."""
    parser = make_parser(__doc__)
    parser.set_defaults(out=Path("runs/entries"))
    parser.add_argument("--tasks", nargs="+", default=["t5-pursuit-v1"], choices=list(STARTS), metavar="TASK")
    parser.add_argument("--methods", nargs="+", default=list(METHODS)[:-1], choices=list(METHODS), metavar="METHOD")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3], metavar="SEED")
    parser.add_argument("--steps", type=int, default=50_000_000, help="decisions of each player")
    parser.add_argument("--worlds", type=int, default=256, help="worlds of each league")
    parser.add_argument("--snapshots", type=int, default=20, help="snapshots of a main player, about")
    parser.add_argument("--episodes", type=int, default=128, help="of each pair in PSRO's payoff table")
    parser.add_argument("--ages", action="store_true", help="also export early and middle policies")
    parser.add_argument("--engine", default="auto", choices=["auto", "c", "jax", "warp"])
    parser.add_argument("--jobs", type=int, default=1, help="leagues at once; several GPUs are shared out")
    parser.add_argument("--store", type=Path, default=Path("runs/baselines"), help="the store of all leagues")
    parser.add_argument("--enter", type=Path, metavar="FOLDER", help="train nothing: measure what --out has")
    parser.add_argument("--track", help="of the tasks, with --enter")
    parser.add_argument("--games", type=int, default=GAMES, help="of each pair, with --enter")
    args = parser.parse_args(argv)
    for name in ("steps", "worlds", "snapshots", "episodes", "jobs"):
        if getattr(args, name) < 1:
            parser.error(f"--{name} is {getattr(args, name)}: give 1 or more")
    return args


def main(argv: Sequence[str] | None = None) -> int:
    """Run the leagues that have not ended, export them, and print what there is."""
    args = parsed(argv)
    # A seed of all methods comes before the next seed, so that a run that ends early compares all methods.
    asked = [(tasks.find(task), method, seed) for task, seed, method in product(args.tasks, args.seeds, args.methods)]
    entries = [entry_of(*each, args) for each in asked]
    ordered = sorted(entries, key=lambda entry: (entry.task.name, list(METHODS).index(entry.method)))
    if args.enter:
        return 1 if enter(ordered, args) else 0

    def tell(line: str) -> None:
        print(line, flush=True)
        export_finished(entries, args)  # at once: a machine may be taken away

    def stop(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, stop)
    export_finished(entries, args)
    failed: Mapping[str, str] = {}
    try:
        while left := [e.run for e in entries if not e.result.exists() and e.run.name not in failed]:
            outcome = SweepWork(str(args.store), args.jobs, tell).work_off(left)
            failed = {**failed, **outcome.failed}
            if outcome.elsewhere:  # or by the processes of a run that was just killed
                time.sleep(PATIENCE)
    finally:
        export_finished(entries, args)
        for line in told(ordered):
            print(line, flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(guarded(main))
