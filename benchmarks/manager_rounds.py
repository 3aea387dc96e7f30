"""The rounds of a league's manager, and the claims and results between them. Prints JSON.

    python -m benchmarks.manager_rounds --store STORE --league LEAGUE [--rounds 20]

`start` reads the state of the league and plans the first jobs, as a manager that begins does. In each round a worker
claims a job and ends it, a turn and a batch of rating matches by turns, and the manager reads what is new and plans
again. Turns end with checkpoints, curves and training games of their players, every fifth with snapshots; batches with
a row of 128 games for each lineup. Written rows stay in the store. Times are processor seconds of this process, so they
leave out those of a server, and seconds by the clock.
"""

import argparse
import json
import resource
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from league.system import environment

environment.prepare()

from league.config import experiment as configuration
from league.scheduling.planner import BEFORE_RATING, Planned, plan
from league.state.jobs import RatingMatch, TrainingTurn, decode
from league.state.league_state import LeagueState
from scripts.record import spread
from storage.records import ArenaKey, Checkpoint, CurvePoint, Job, Lease, Match, Meeting, PairCounts, Snapshot
from storage.store import Store

GAMES = 128  # of a match row
FREEZE = 5  # a snapshot of each learner at every so many turns


class Rounds:
    """A manager's view of a league, the jobs that were done for it, and the time that each step took."""

    def __init__(self, store: Store, league: str):
        self.store, self.league = store, league
        self.config = configuration.loads(store.league(league).config)
        self.state: LeagueState | None = None
        self.turns = 0
        self.times: dict[str, list[tuple[float, float]]] = defaultdict(list)

    def manage(self, title: str) -> None:
        """Read what is new and queue what follows."""
        with self.timed(f"{title}-read"):
            self.state = LeagueState.of(self.store, self.league, self.state)
        with self.timed(f"{title}-plan"):
            planned: Planned = plan(self.config, self.state, BEFORE_RATING)
        with self.timed(f"{title}-queue"):
            if planned.jobs or planned.phases:
                self.store.queue(planned.jobs, planned.phases)

    def work(self, kind: str) -> bool:
        """Claim a job of a kind and end it; False if there is none."""
        with self.timed(f"claim-{kind}"):
            claimed = self.store.claim(self.league, [kind], "host:1:worker", 60.0)
        if claimed is None:
            return False
        lease, job = claimed
        results = self._turn(job) if kind == TrainingTurn.kind else self._batch(job)
        with self.timed(f"finish-{kind}"):
            self._finish(lease, results)
        return True

    def _finish(self, lease: Lease, results: dict[str, Any]) -> None:
        self.store.finish(lease, keep=8, **results)

    def _batch(self, job: Job) -> dict[str, Any]:
        task = decode(job)
        assert isinstance(task, RatingMatch)
        assert self.state is not None
        key = self.state.arena or ArenaKey("sumo-1v1", "0", "c")
        rows = [
            Match(self.league, key, str(lineup[0]), lineup[1], 50, 28, 50, 0, 25, 14, 25, PairCounts(8, 12, 24, 12, 8),
                  seed=task.seed, seconds=0.5, due=task.due)
            for lineup in task.lineups
        ]  # fmt: skip
        return {"matches": rows}

    def _turn(self, job: Job) -> dict[str, Any]:
        task = decode(job)
        assert isinstance(task, TrainingTurn)
        assert self.state is not None
        self.turns += 1
        found: dict[str, Any] = defaultdict(list)
        digest = self.store.blobs.put(f"the state after job {job.id}, made at {time.time()}".encode())
        for name in task.learners:
            at = self.state.checkpoints[name]
            iteration, step = at.iteration + task.iterations, at.step + 1000 * task.iterations
            new = Checkpoint(self.league, name, digest, step, iteration, at.seconds + 10.0, at.arena)
            found["checkpoints"].append(new)
            values = {"score": 0.5, "reward": 0.1, "length": 200.0, "episodes": 64.0, "entropy": 1.0}
            found["curves"] += [
                CurvePoint(self.league, name, i, step, at.seconds, values)
                for i in range(at.iteration + 1, iteration + 1)
            ]
            met = {seat for group in task.past.get(name, ()) for seat in group if seat and seat != name}
            found["meetings"] += [
                Meeting(self.league, name, iteration, other, 6, 1, 1, chance=0.1, pool=10) for other in sorted(met)
            ]
            if self.turns % FREEZE == 0:
                own = self.state.history(name)[-1]
                found["snapshots"].append(Snapshot(
                    self.league, f"{name}@{iteration}", digest, own.roster, name, iteration=iteration, step=step,
                    seconds=at.seconds, arena=own.arena, parent=own.name, settings=own.settings,
                ))  # fmt: skip
        return {"bases": task.bases, **found}

    @contextmanager
    def timed(self, title: str) -> Iterator[None]:
        """Note what a step takes."""
        start = time.perf_counter(), time.process_time()
        yield
        self.times[title].append((time.perf_counter() - start[0], time.process_time() - start[1]))


def main() -> None:
    """Do the rounds and print the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", required=True)
    parser.add_argument("--blobs")
    parser.add_argument("--league", required=True)
    parser.add_argument("--rounds", type=int, default=20)
    args = parser.parse_args()
    with Store.open(args.store, blobs=args.blobs) as store:
        rounds = Rounds(store, args.league)
        rounds.manage("start")
        print({k: v[0] for k, v in rounds.times.items()}, file=sys.stderr, flush=True)
        for i in range(args.rounds):
            kinds = (TrainingTurn.kind, RatingMatch.kind)
            kind = next((kind for kind in (kinds[i % 2], kinds[1 - i % 2]) if rounds.work(kind)), None)
            if kind is None:
                break
            rounds.manage(f"after-{kind}")
    found = {
        title: {"seconds": spread([t[0] for t in times], 4), "processor_seconds": spread([t[1] for t in times], 4)}
        for title, times in rounds.times.items()
    }
    peak = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    print(json.dumps({"steps": found, "peak_mb": peak}))


if __name__ == "__main__":
    main()
