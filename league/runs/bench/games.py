"""Games of a task, played in a store that is removed afterwards, and their counts as rows of JSON.

All entries meet a reference from the same seeds, in batches of `BATCH` games, of which half repeat the other half's
starts with sides swapped where sides are alike.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from zlib import crc32

from dashboards.system.temporary_folders import temporary_folder
from league.matches.evaluator import MatchEvaluator
from league.queries.query import Open
from league.runs.bench.partial_rows import PartialRows, Row
from league.runs.bench.tasks import BATCH, Task
from league.runtime.bootstrap import create
from league.state.jobs import RatingMatch
from storage.records import ArenaKey, Match, PairCounts
from storage.store import Store

LEAGUE = "bench"
Progress = Callable[[int], None]


@dataclass(frozen=True)
class BenchLeague:
    """A league of a task in a temporary store, with its programs of matches."""

    task: Task
    opened: Open
    folder: Path
    evaluator: MatchEvaluator

    def play(
        self, a: str, b: str, games: int, seed: int, progress: Progress = lambda games: None,
        partial: PartialRows | None = None,
    ) -> list[Row]:  # fmt: skip
        """Play a number of games, a multiple of the evaluator's batch, and return a row for each batch.

        The seeds of the batches depend on `seed` and on `b`, the reference; `progress` is called with the games of each
        batch. Batches that `partial` has are not played again, and it gets the others.
        """
        rows, partial = [], partial or PartialRows(None, {})
        for number in range(games // self.batch):
            own = batch_seed(self.task, seed, b, number)
            rows.append(partial.find(a=a, b=b, seed=own) or partial.add(self._batch(a, b, own)))
            progress(self.batch)
        return rows

    def _batch(self, a: str, b: str, seed: int) -> Row:
        (match,) = self.evaluator.play(self.opened.store, RatingMatch(((a, b),), seed, record=False))
        assert isinstance(match, Match)
        return row_of(match)

    def make_room(self) -> None:
        """Prepare one program of matches for all that the league has."""
        store = self.opened.store
        self.evaluator.make_room(store, [s for s in store.snapshots(LEAGUE) if not s.initial])

    @property
    def batch(self) -> int:
        """Number of games that are played at once."""
        return self.evaluator.groups * self.evaluator.each


def batch_seed(task: Task, seed: int, b: str, number: int) -> int:
    """Return the seed of batch `number`, from 0, of games against `b` in an entry that was played from `seed`."""
    return crc32(f"{task.name}/{seed}/{b}/{number}".encode())


@contextmanager
def bench_league(task: Task, games: int) -> Iterator[BenchLeague]:
    """Yield a league of the task whose batches have `games` games, or `BATCH` if that is fewer.

    Raises ConfigError if the code computes another configuration hash than the task's.
    """
    config, worlds = task.config(), min(games, BATCH)
    config = replace(
        config, league=LEAGUE, seed=task.seed % 2**31,
        rating=replace(config.rating, worlds=worlds, pairings=1, record=False, trained=False),
    )  # fmt: skip
    arena = task.build(worlds)
    with temporary_folder("robot-league-bench-") as folder, Store.open(folder, create=True) as store:
        create(store, config, arena)
        yield BenchLeague(task, Open(store, LEAGUE), Path(folder), MatchEvaluator(config, arena, LEAGUE))


def row_of(match: Match) -> Row:
    """Return the counts of a match as JSON has them: for A, in all games, as the first side, and by seed pairs."""
    return {
        "a": match.a, "b": match.b, "seed": match.seed, "results": [match.wins, match.draws, match.losses],
        "first_side": [match.side_wins, match.side_draws, match.side_losses], "seed_pairs": list(match.pairs),
        "voids": match.voids, "voids_by_a": match.voids_a, "voids_by_b": match.voids_b, "steps": match.steps,
    }  # fmt: skip


def match_of(row: Row, task: Task) -> Match:
    """Return a row as a match for a fit. A game that A's robots alone made void is lost: nobody gains by breaking it.

    Raises KeyError, TypeError or ValueError for what is no row.
    """
    wins, draws, losses = map(int, row["results"])
    own = int(row["voids_by_a"])
    return Match(
        LEAGUE, ArenaKey(task.arena, task.config_hash, "c"), str(row["a"]), str(row["b"]),
        wins, draws, losses + own, int(row["voids"]) - own, *map(int, row["first_side"]),
        pairs=PairCounts(*map(int, row["seed_pairs"])), seed=int(row["seed"]), voids_b=int(row["voids_by_b"]),
    )  # fmt: skip
