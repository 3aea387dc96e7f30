"""Cost of learning in comparison with physics: ratios, each measured in one process on one device.

    python -m benchmarks.train --worlds 256 --out benchmarks/results/train-cpu.json
    python -m benchmarks.train --worlds 4096 16384 --seconds 120 --out benchmarks/results/train-h100.json
    python -m benchmarks.train --rows memory --arena sumo-1v1 --worlds 16 --decisions 8 --out memory-cpu.json
    python -m benchmarks.train --rows memory --arena sumo-2v2-anymal --worlds 16384 --iterations 20

The two parts of a row alternate `--repeats` times, after one pair that compiles and does not count; a ratio is computed
for each pair, by wall-clock time and by CPU time. Speeds are control steps/s of all worlds together, in `league`
decisions/s. The rows:

- rollout: rollout of the learning policies of all teams / the bare engine that replays the same controls
- training: rollout and updates of all teams / that rollout alone
- busy: seconds of one team's update / seconds of GPU kernels within it, from torch's profiler (GPU only). Kernels that
  run at the same time count in full, so the ratio may be below 1. Also the longest kernels by name, and the seconds in
  which any kernel ran: the rest of the update are gaps between kernels
- jax: seconds of one team's update / those of the same update in plain JAX, compiled as one program
  (benchmarks/happo_jax.py), and the largest difference of the results from the same parameters, batch and permutations
- captures: how often Warp records its graph again in an iteration, and the share of time that this takes (GPU only):
  XLA may move the buffers that it passes
- opponents: rollout and one team's update against K frozen opponents / against one
- league: a `league run` with past opponents, snapshots, store, rating and recording / rollout and updates alone, before
  and after it; by its learning curves, which count time within turns, and by the store's dates, which count all time
- memory: resident set at the end of `--iterations` of rollout and updates of all teams / that after the first tenth; on
  a GPU the target is the maximum of GB in use on the device (benchmarks/memory.py)
- quickstart: training in the quick start's league / the bare engine that replays the same controls (CPU only)

Policies begin fresh with the league's default learner and continue learning from row to row. Only the league runs in
processes of its own. Prints and writes JSON.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import get_args

from league.system.environment import prepare

prepare()  # before jax reads the environment

import jax
import numpy as np
import torch

from agents.learner.happo import HappoLearner
from agents.settings import Precision
from arenas.physics.cpu import cores
from benchmarks import happo_jax
from benchmarks.kernels import captures, profiled
from benchmarks.loop import Ground, Loop, ratio, speeds, timed, turns
from benchmarks.memory import memory
from league.config import experiment as configuration
from league.config import presets
from scripts.record import make_parser, run_info, spread, write
from storage.store import Store

OPPONENTS = (16, 64)  # numbers of frozen opponents
LONGEST = 40  # kernels of an update that are listed by name
QUICKSTART_WORLDS = 256
LEAGUE = "benchmark"
PAST = ["--training.opponents.kind", "uniform", "--training.opponents.past", "0.25"]  # the default has none


def main() -> None:
    """Measure and write the JSON after each row."""
    args = arguments()
    torch.set_num_threads(max(1, cores() // 2))  # as in a worker of a league
    result = {**run_info(args.commit), "rows": []}
    for found in measured(args):
        print(json.dumps(found, indent=1), flush=True)
        result["rows"].append(found)
        write(result, args.out)


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=[n for n in ROWS if n != "memory"])
    parser.add_argument("--arena", default="sumo-2v2")
    parser.add_argument("--engine", default="auto", help="auto, c, jax, warp")
    parser.add_argument("--worlds", type=int, nargs="+", default=[256])
    parser.add_argument("--no-graphs", dest="graphs", action="store_false", help="learn without CUDA graphs")
    parser.add_argument("--compiled", action="store_true", help="compile losses by torch.compile")
    parser.add_argument("--precision", choices=get_args(Precision), default="float32", help="of the learner's products")
    parser.add_argument("--decisions", type=int, default=32, help="of a rollout")
    parser.add_argument("--repeats", type=int, default=8, help="timed repetitions of each part")
    parser.add_argument("--warm", type=float, default=8.0, help="seconds of play before the first repetition")
    parser.add_argument("--iterations", type=int, default=1000, help="of the row memory")
    parser.add_argument("--seconds", type=int, default=60, help="of training, for the league")
    return parser.parse_args()


def measured(args: argparse.Namespace) -> Iterator[dict]:
    """Yield every row; rows with the same number of worlds share the arena and its compiled rollout."""
    kind = "cpu" if jax.default_backend() == "cpu" else "gpu"
    config = replace(configuration.default(args.arena), engine=args.engine)
    config = replace(
        config,
        learner=replace(config.learner, cuda_graphs=args.graphs, precision=args.precision, compiled=args.compiled),
    )
    places = [(config, worlds, [name for name in args.rows if name != "quickstart"]) for worlds in args.worlds]
    places += [(presets.preset("quickstart"), QUICKSTART_WORLDS, [name for name in args.rows if name == "quickstart"])]
    for settings, worlds, names in places:
        ground = Ground(settings, worlds, args) if names else None
        for name in names:
            row = ROWS[name]
            about = {"row": name, "arena": ground.arena.name, "engine": ground.arena.engine.name, "worlds": worlds}
            asked = {"cpu": row.cpu, "gpu": row.gpu}[kind]
            yield about | row.measure(ground) | {"target": asked and f"{row.asked} {asked}"}


# The rows ------------------------------------------------------------------------------------------------------------


def rollout(ground: Ground) -> dict:
    """Compare a rollout with the bare engine."""
    return ground.loop.beside_bare(ground.loop.roll)


def training(ground: Ground) -> dict:
    """Compare rollout and updates with rollout alone."""
    loop = ground.loop
    took = turns({"rollout": partial(loop.play, loop.roll), "training": partial(loop.play, loop.learn)}, ground.repeats)
    return speeds(took, loop.worlds * ground.steps) | ratio(took["rollout"], took["training"])


def busy(ground: Ground) -> dict:
    """Compare one team's update with the GPU kernels in it."""
    loop = ground.loop
    learner = loop.learners[0]
    if learner.device.type != "cuda":
        return {"ratio": None, "why": "torch learns on the CPU, where there are no kernels to wait for"}
    batch = loop.batch(0, loop.trajectory)
    start = learner.save()
    wall, kernels = [], []
    for _ in range(ground.repeats + 1):  # separately, because the profiler slows down the host
        wall.append(timed(partial(learner.learn, batch), partial(settled, learner, start)))
        settled(learner, start)
        kernels.append(profiled(partial(learner.learn, batch)))
    if not kernels[-1]["kernels"]:
        return {"ratio": None, "why": "torch's profiler saw no kernels here"}
    wall, seconds = np.array(wall[1:])[:, 0], np.array([each["seconds"] for each in kernels[1:]])
    return {
        "ratio": spread(wall / seconds), "update_seconds": spread(wall, 5), "busy_seconds": spread(seconds, 5),
        "at_work_seconds": spread(np.array([each["at_work"] for each in kernels[1:]]), 5),
        "kernels": kernels[-1]["kernels"], "launches": kernels[-1]["launches"], "samples": batch.rewards.numel(),
        "by_name": dict(list(kernels[-1]["by_name"].items())[:LONGEST]),
    }  # fmt: skip


def recorded(ground: Ground) -> dict:
    """Return the share of the time of rollout and updates in which Warp records graphs."""
    if ground.arena.engine.name != "warp":
        return {"ratio": None, "why": "Warp alone records graphs"}
    loop, each, share = ground.loop, [], []
    for _ in range(ground.repeats):
        with captures() as took:
            seconds = loop.play(loop.learn)[0]
        each.append(len(took))
        share.append(sum(took) / seconds)
    return {"ratio": spread(np.array(share)), "captures": each}


def settled(learner: HappoLearner, state: Mapping[str, np.ndarray]) -> None:
    """Load a state into a learner, and wait until it is on the device."""
    learner.load(state)
    if learner.device.type == "cuda":
        torch.cuda.synchronize()


def plain_jax(ground: Ground) -> dict:
    """Compare one team's update with the same update in plain JAX, from the same state every time."""
    loop = ground.loop
    loop.play(loop.roll)  # with the present policies
    if not all(each.all() for each in loop.trajectory.alive.values()):
        return {"ratio": None, "why": "agents may leave this game, and the update in JAX has no masks"}
    learner = ground.learners(fixed_order=True)[0]
    learner.load(loop.learners[0].save())
    c, start = learner.config, learner.save()
    sound = np.flatnonzero(~np.asarray(loop.trajectory.void).any(0))
    batch = loop.batch(0, loop.trajectory, sound[: len(sound) // c.minibatches * c.minibatches])
    team, same, size = happo_jax.team_of(learner), happo_jax.batch_of(batch), batch.rewards.numel()
    update = happo_jax.make_update(c)
    agents = len(team.actors)
    # The batch is an argument: with a constant, XLA would precompute everything that depends only on it.
    whole = jax.jit(lambda team, batch, key: update(team, batch, happo_jax.draw(key, agents + 1, c.epochs, size)))
    ours = partial(timed, partial(learner.learn, batch), partial(settled, learner, start))
    took = turns({"torch": ours, "jax": lambda: timed(partial(whole, team, same, jax.random.key(0)))}, ground.repeats)
    settled(learner, start)
    moved, figures = jax.jit(update)(team, same, happo_jax.permutations_of(learner, size))
    found = learner.learn(batch)
    after = happo_jax.team_of(learner)
    return {
        "update_seconds": {name: spread(each[:, 0], 5) for name, each in took.items()}, "samples": size,
        "max_parameter_difference": happo_jax.gap(moved, after), "max_parameter_change": happo_jax.gap(team, after),
        "policy_loss": [found["policy_loss"], float(figures["policy_loss"])],
        "value_loss": [found["value_loss"], float(figures["critic_loss"])],
    } | ratio(took["torch"], took["jax"])  # fmt: skip


def opponents(ground: Ground) -> dict:
    """Compare training against K frozen opponents with training against one."""
    several = [k for k in OPPONENTS if k <= ground.worlds]
    if not several or len(ground.arena.teams) == 1:
        return {
            "ratio": None,
            "why": f"{ground.worlds} worlds of {len(ground.arena.teams)} teams have no groups for them",
        }
    frozen = [ground.learners(2 + k) for k in range(max(several))]
    loops = {k: Loop(ground, frozen[:k]) for k in (1, *several)}
    took = turns({str(k): partial(loop.play, loop.learn) for k, loop in loops.items()}, ground.repeats)
    each = {k: took[str(k)] / (loop.worlds * ground.steps) for k, loop in loops.items()}  # s per step
    return {
        "steps_per_second": {str(k): spread(1 / of[:, 0], 0) for k, of in each.items()},
        "of": {str(k): ratio(each[1], each[k]) for k in several},
    }


def quickstart(ground: Ground) -> dict:
    """Compare rollout and updates with the bare engine, in the quick start's league."""
    if jax.default_backend() != "cpu":
        return {"ratio": None, "why": "the quick start is for a CPU"}
    return ground.loop.beside_bare(ground.loop.learn)


def league(ground: Ground) -> dict:
    """Compare decisions/s of a league with rollouts and updates alone, which run before and after it."""
    loop, seconds = ground.loop, ground.args.seconds
    fixed = [decisions_per_second(loop, seconds / 2)]
    with tempfile.TemporaryDirectory() as folder:
        found = of_league(ground, Path(folder, "store"), seconds)
    fixed.append(decisions_per_second(loop, seconds / 2))
    ratios = {name: found[name] / np.array(fixed) for name in ("in_turns", "all_told") if found[name]}
    return {
        "ratio": spread(ratios["in_turns"]),
        "ratio_all_told": spread(ratios["all_told"]) if "all_told" in ratios else None,
        "decisions_per_second": {"fixed": spread(fixed, 0)}, "league": found,
    }  # fmt: skip


def decisions_per_second(loop: Loop, seconds: float) -> float:
    """Return decisions/s of rollouts and updates, all worlds together, after one iteration that compiles."""
    loop.play(loop.learn)
    began, iterations = time.perf_counter(), 0
    while time.perf_counter() - began < seconds:
        loop.play(loop.learn)
        iterations += 1
    return iterations * loop.ground.args.decisions * loop.worlds / (time.perf_counter() - began)


def of_league(ground: Ground, where: Path, seconds: int) -> dict:
    """Run a league in processes of its own, with nothing else on the device, and read its figures from its store.

    `in_turns` is decisions/s by the time of the learning curves. `all_told` also counts time between turns, from the
    first to the last kept checkpoint by the dates in the store; None if only one is kept.
    """
    flags = PAST if len(ground.arena.teams) > 1 else []
    command = [
        sys.executable, "-m", "league", "run", "--store", str(where), "--league", LEAGUE,
        "--arena.name", ground.arena.name, "--engine", ground.arena.engine.name, "--for", f"{seconds}s",
        "--budget.rating_time", "0s", "--training.worlds", str(ground.worlds),
        "--training.rollout_length", str(ground.args.decisions), f"--learner.cuda_graphs={ground.args.graphs}",
        f"--learner.compiled={ground.args.compiled}",
        "--learner.precision", ground.args.precision, *flags,
    ]  # fmt: skip
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    with Store.open(where) as store:
        last = max(store.curves(LEAGUE), key=lambda point: point.seconds)
        kept = [c for c in store.checkpoints(LEAGUE) if c.player == last.player and c.iteration > 0]
        span, matches = kept[-1].created - kept[0].created, store.matches(LEAGUE)
        return {
            "in_turns": round(last.step / last.seconds),
            "all_told": round((kept[-1].step - kept[0].step) / span) if span else None,
            "iterations": last.iteration, "past_share": round(last.values["past_share"], 3),
            "snapshots": len(store.snapshots(LEAGUE)), "recordings": sum(m.recording is not None for m in matches),
            "rated_episodes": sum(m.wins + m.draws + m.losses for m in matches), "flags": flags,
        }  # fmt: skip


@dataclass(frozen=True)
class Row:
    """The measurement of a row, and the targets of its ratio on a GPU and on a CPU.

    For `memory` the GPU's target applies to `device_gb`.
    """

    measure: Callable[[Ground], dict]
    asked: str
    gpu: float | None
    cpu: float | None


ROWS = {
    "rollout": Row(rollout, "at least", 0.95, 0.85),
    "training": Row(training, "at least", 0.90, 0.90),
    "busy": Row(busy, "at most", 1.25, None),
    "jax": Row(plain_jax, "at most", 1.15, 1.15),
    "captures": Row(recorded, "at most", None, None),
    "opponents": Row(opponents, "at least", 0.90, 0.90),
    "league": Row(league, "at least", 0.90, 0.90),
    "memory": Row(memory, "at most", 40.0, 1.01),
    "quickstart": Row(quickstart, "at least", None, 0.82),
}

if __name__ == "__main__":
    main()
