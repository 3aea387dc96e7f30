"""What learning costs beside physics: ratios, each measured in one process on one device. Prints and writes JSON.

    python benchmarks/train.py --worlds 256 --out benchmarks/results/train-cpu.json
    python benchmarks/train.py --worlds 4096 16384 --seconds 120 --out benchmarks/results/train-h100.json
    python benchmarks/train.py --rows memory --arena sumo-1v1 --worlds 16 --decisions 8  # and --out memory-cpu.json
    python benchmarks/train.py --rows memory --arena sumo-2v2-anymal --worlds 16384 --iterations 20

What a row compares takes turns, `--repeats` times after one turn that compiles and is not counted; a ratio is that of
each pair of turns, by the wall's clock and by CPU time. Speeds are control steps/s of all worlds together, in `league`
decisions/s. The rows:

- rollout: rollout of the learning policies of all teams / the bare engine that replays the same controls
- training: rollout and updates of all teams / that rollout alone
- busy: seconds of one team's update / seconds of GPU kernels within it, as torch's profiler has them (GPU only);
  kernels that run at the same time all count, so the ratio may be below 1. And the longest kernels by name, and for
  how many seconds any kernel ran: what is missing to the update's are gaps between kernels
- jax: seconds of one team's update / those of the same update in plain JAX, compiled whole (benchmarks/happo_jax.py),
  and how far apart the two end from the same parameters, batch and permutations
- captures: how often Warp records its graph anew in a turn of rollout and updates, and seconds of that / of the turn
  (GPU only): XLA may move the buffers that it is called with
- opponents: rollout and one team's update against K frozen opponents / against one
- league: a `league run` with past opponents, snapshots, store, rating and recording / rollout and updates alone, before
  and after it; by its curves, which count time within turns, and by the store's dates, which count all
- memory: the resident set at the end of `--iterations` of rollout and updates of all teams / that after the first tenth
  of them; on a GPU the target is GB of the device that were in use, beside it (benchmarks/memory.py)
- quickstart: training in the quick start's league / the bare engine that replays the same controls (CPU only)

Policies are fresh ones with the league's default learner, and go on learning from row to row. Only the league has
processes of its own.
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

# Not this folder, whose arenas.py would hide the package of that name.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from league.environment import prepare  # noqa: E402

prepare()  # before jax reads the environment

import jax  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402

from agents.happo import Learner  # noqa: E402
from agents.settings import Precision  # noqa: E402
from arenas.cores import cores  # noqa: E402
from benchmarks import happo_jax  # noqa: E402
from benchmarks.kernels import captures, profiled  # noqa: E402
from benchmarks.loop import Ground, Loop, ratio, speeds, timed, turns  # noqa: E402
from benchmarks.memory import memory  # noqa: E402
from benchmarks.record import commit, machine, spread  # noqa: E402
from league.config import experiment as configuration  # noqa: E402
from league.config import presets  # noqa: E402
from league.versions import versions  # noqa: E402
from storage.store import Store  # noqa: E402

OPPONENTS = (16, 64)  # how many frozen ones
LONGEST = 40  # of an update's kernels, as many are told by name
QUICKSTART_WORLDS = 256
LEAGUE = "benchmark"
PAST = ["--training.opponents.kind", "uniform", "--training.opponents.past", "0.25"]  # by default there are none


def main() -> None:
    """Measure and write the JSON after each row."""
    args = arguments()
    torch.set_num_threads(max(1, cores() // 2))  # as in a worker of a league
    result = {
        "command": " ".join(["python", *sys.argv]), "commit": args.commit or commit(), "machine": machine(),
        "versions": versions(), "rows": [],
    }  # fmt: skip
    for found in measured(args):
        print(json.dumps(found, indent=1), flush=True)
        result["rows"].append(found)
        if args.out:
            args.out.write_text(json.dumps(result, indent=1) + "\n")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=[n for n in ROWS if n != "memory"])
    parser.add_argument("--arena", default="sumo-2v2")
    parser.add_argument("--engine", default="auto", help="auto, c, jax, warp")
    parser.add_argument("--worlds", type=int, nargs="+", default=[256])
    parser.add_argument("--no-graphs", dest="graphs", action="store_false", help="launch every kernel by itself")
    parser.add_argument("--compiled", action="store_true", help="losses compiled by torch.compile")
    parser.add_argument("--precision", choices=get_args(Precision), default="float32", help="of the learner's products")
    parser.add_argument("--decisions", type=int, default=32, help="of a rollout")
    parser.add_argument("--repeats", type=int, default=8, help="turns that are timed")
    parser.add_argument("--warm", type=float, default=8.0, help="seconds of play before the first of them")
    parser.add_argument("--iterations", type=int, default=1000, help="of the row memory")
    parser.add_argument("--seconds", type=int, default=60, help="of training, for the league")
    parser.add_argument("--commit", default="", help="the commit, where there is no git to ask")
    parser.add_argument("--out", type=Path)
    return parser.parse_args()


def measured(args: argparse.Namespace) -> Iterator[dict]:
    """Every row, one number of worlds after the other; those of one share arena and compiled rollout."""
    kind = "cpu" if jax.default_backend() == "cpu" else "gpu"
    config = replace(configuration.default(args.arena), engine=args.engine)
    config = replace(
        config, learner=replace(config.learner, graphs=args.graphs, precision=args.precision, compiled=args.compiled)
    )
    places = [(config, worlds, [name for name in args.rows if name != "quickstart"]) for worlds in args.worlds]
    places += [(presets.quickstart(), QUICKSTART_WORLDS, [name for name in args.rows if name == "quickstart"])]
    for settings, worlds, names in places:
        ground = Ground(settings, worlds, args) if names else None
        for name in names:
            row = ROWS[name]
            about = {"row": name, "arena": ground.arena.name, "engine": ground.arena.engine.name, "worlds": worlds}
            asked = {"cpu": row.cpu, "gpu": row.gpu}[kind]
            yield about | row.measure(ground) | {"target": asked and f"{row.asked} {asked}"}


# The rows ------------------------------------------------------------------------------------------------------------


def rollout(ground: Ground) -> dict:
    """Rollout over the bare engine."""
    return ground.loop.beside_bare(ground.loop.roll)


def training(ground: Ground) -> dict:
    """Rollout and updates over rollout alone."""
    loop = ground.loop
    took = turns({"rollout": partial(loop.play, loop.roll), "training": partial(loop.play, loop.learn)}, ground.repeats)
    return speeds(took, loop.worlds * ground.steps) | ratio(took["rollout"], took["training"])


def busy(ground: Ground) -> dict:
    """One team's update over what the GPU does in it."""
    loop = ground.loop
    learner = loop.learners[0]
    if learner.device.type != "cuda":
        return {"ratio": None, "why": "torch learns on the CPU, where there are no kernels to wait for"}
    batch = loop.batch(0, loop.trajectory)
    start = learner.state()
    wall, kernels = [], []
    for _ in range(ground.repeats + 1):  # the profiler slows down the host: what it sees is timed apart
        wall.append(timed(partial(learner.update, batch), partial(settled, learner, start)))
        settled(learner, start)
        kernels.append(profiled(partial(learner.update, batch)))
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
    """Seconds in which Warp records graphs over those of rollouts and updates, turn by turn."""
    if ground.arena.engine.name != "warp":
        return {"ratio": None, "why": "Warp alone records graphs"}
    loop, each, share = ground.loop, [], []
    for _ in range(ground.repeats):
        with captures() as took:
            seconds = loop.play(loop.learn)[0]
        each.append(len(took))
        share.append(sum(took) / seconds)
    return {"ratio": spread(np.array(share)), "captures": each}


def settled(learner: Learner, state: Mapping[str, np.ndarray]) -> None:
    """Bring a learner back to a state, and wait until it stands there."""
    learner.load(state)
    if learner.device.type == "cuda":
        torch.cuda.synchronize()


def plain_jax(ground: Ground) -> dict:
    """One team's update over the same in plain JAX, from the same state every time."""
    loop = ground.loop
    loop.play(loop.roll)  # with the policies as they are now
    if not all(each.all() for each in loop.trajectory.alive.values()):
        return {"ratio": None, "why": "agents may leave this game, and the update in JAX has no masks"}
    learner = ground.learners(fixed_order=True)[0]
    learner.load(loop.learners[0].state())
    c, start = learner.config, learner.state()
    sound = np.flatnonzero(~np.asarray(loop.trajectory.void).any(0))
    batch = loop.batch(0, loop.trajectory, sound[: len(sound) // c.minibatches * c.minibatches])
    team, same, size = happo_jax.team_of(learner), happo_jax.batch_of(batch), batch.rewards.numel()
    update = happo_jax.make_update(c)
    agents = len(team.actors)
    # The batch is an argument: of a constant XLA would compute beforehand what depends on nothing else.
    whole = jax.jit(lambda team, batch, key: update(team, batch, happo_jax.draw(key, agents + 1, c.epochs, size)))
    ours = partial(timed, partial(learner.update, batch), partial(settled, learner, start))
    took = turns({"torch": ours, "jax": lambda: timed(partial(whole, team, same, jax.random.key(0)))}, ground.repeats)
    settled(learner, start)
    moved, told = jax.jit(update)(team, same, happo_jax.permutations_of(learner, size))
    found = learner.update(batch)
    after = happo_jax.team_of(learner)
    return {
        "update_seconds": {name: spread(each[:, 0], 5) for name, each in took.items()}, "samples": size,
        "max_parameter_difference": happo_jax.gap(moved, after), "max_parameter_change": happo_jax.gap(team, after),
        "policy_loss": [found["policy_loss"], float(told["policy_loss"])],
        "value_loss": [found["value_loss"], float(told["critic_loss"])],
    } | ratio(took["torch"], took["jax"])  # fmt: skip


def opponents(ground: Ground) -> dict:
    """Training against K frozen opponents over training against one."""
    several = [k for k in OPPONENTS if k <= ground.worlds]
    if not several or len(ground.arena.teams) == 1:
        return {
            "ratio": None,
            "why": f"{ground.worlds} worlds of {len(ground.arena.teams)} teams have no groups for them",
        }
    frozen = [ground.learners(2 + k) for k in range(max(several))]
    loops = {k: Loop(ground, frozen[:k]) for k in (1, *several)}
    took = turns({str(k): partial(loop.play, loop.learn) for k, loop in loops.items()}, ground.repeats)
    each = {k: took[str(k)] / (loop.worlds * ground.steps) for k, loop in loops.items()}  # s for a step
    return {
        "steps_per_second": {str(k): spread(1 / of[:, 0], 0) for k, of in each.items()},
        "of": {str(k): ratio(each[1], each[k]) for k in several},
    }


def quickstart(ground: Ground) -> dict:
    """Rollout and updates over the bare engine, in the quick start's league."""
    if jax.default_backend() != "cpu":
        return {"ratio": None, "why": "the quick start is for a CPU"}
    return ground.loop.beside_bare(ground.loop.learn)


def league(ground: Ground) -> dict:
    """Decisions/s of training in a league over those of rollouts and updates alone, before it and after it."""
    loop, seconds = ground.loop, ground.args.seconds
    fixed = [decisions_per_second(loop, seconds / 2)]
    with tempfile.TemporaryDirectory() as folder:
        found = of_league(ground, Path(folder, "store"), seconds)
    fixed.append(decisions_per_second(loop, seconds / 2))
    told = {name: found[name] / np.array(fixed) for name in ("in_turns", "all_told") if found[name]}
    return {
        "ratio": spread(told["in_turns"]), "ratio_all_told": spread(told["all_told"]) if "all_told" in told else None,
        "decisions_per_second": {"fixed": spread(fixed, 0)}, "league": found,
    }  # fmt: skip


def decisions_per_second(loop: Loop, seconds: float) -> float:
    """Of rollouts and updates for so long, all worlds together; one uncounted turn compiles."""
    loop.play(loop.learn)
    began, iterations = time.perf_counter(), 0
    while time.perf_counter() - began < seconds:
        loop.play(loop.learn)
        iterations += 1
    return iterations * loop.ground.args.decisions * loop.worlds / (time.perf_counter() - began)


def of_league(ground: Ground, where: Path, seconds: int) -> dict:
    """Run a league in processes of its own, which share the device while nothing else is measured; read its store.

    `in_turns` is decisions/s as the learning curves count time. `all_told` also counts what lies between turns: from
    the first to the last of the checkpoints that are kept, as the store dates them; None where that is one.
    """
    flags = PAST if len(ground.arena.teams) > 1 else []
    command = [
        sys.executable, "-m", "league", "run", "--store", str(where), "--league", LEAGUE,
        "--arena.name", ground.arena.name, "--engine", ground.arena.engine.name, "--for", f"{seconds}s",
        "--budget.rate", "0s", "--training.worlds", str(ground.worlds),
        "--training.rollout", str(ground.args.decisions), f"--learner.graphs={ground.args.graphs}",
        f"--learner.compiled={ground.args.compiled}",
        "--learner.precision", ground.args.precision, *flags,
    ]  # fmt: skip
    subprocess.run(command, cwd=sys.path[0], check=True, stdout=subprocess.DEVNULL)
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
    """What measures a row, and what is asked of its ratio on a GPU and on a CPU.

    Of `memory` it is asked on a GPU of `device_gb`.
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
