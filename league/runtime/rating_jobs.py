"""The rating jobs of a worker: it plays batches of matches, and leaves training its share of a GPU."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from league.runtime.heartbeat import none_on_error
from league.state.jobs import RatingMatch, TrainingTurn
from league.system import devices
from storage.errors import LeaseLost
from storage.records import Lease

if TYPE_CHECKING:
    from league.matches.evaluator import MatchEvaluator
    from league.runtime.worker import Worker
    from league.system.gpu_sharing import Pace

NEAR = 30.0  # seconds without a heartbeat after which a worker counts as gone


class RatingJobs:
    """The rating jobs of a worker; the compiled matches stay in memory between them."""

    def __init__(self, worker: "Worker"):
        self._worker = worker
        self._evaluator: MatchEvaluator | None = None
        self._speed: dict[str, float] = {}  # of the newest batch, for the status
        self._looks_early = worker.config.budget.by_rating and worker.config.rating.share > 0

    def compile_early(self) -> None:
        """Compile the match before the first job, where ratings decide when training ends.

        There the first job comes late (`match_scheduler.FIRST_RATED`), and nobody would learn the result while it
        compiled. It begins when players have learnt, because until then training compiles the same kernels. Raises
        nothing: what fails here fails again with the first job, which reports it.
        """
        if not self._looks_early or RatingMatch.kind not in self._worker.spec.kinds:
            return
        newest = none_on_error(self._worker.store.newest_checkpoints, self._worker.config.league) or {}
        if all(checkpoint.iteration == 0 for checkpoint in newest.values()):
            return
        self._looks_early = False
        with suppress(Exception), self._expendable():
            self._compiled().compile(self._worker.store)

    def play(self, lease: Lease, task: RatingMatch) -> None:
        """Play the matches of a job and finish it. Raises LeaseLost, and any error of playing."""
        self._looks_early = False
        worker = self._worker
        with self._expendable():
            evaluator = self._compiled()
        said = {"doing": "rating", "pairs": len(task.lineups)}  # and no more of a turn that it has trained before
        worker.status = {**said, **self._speed}
        matches = evaluator.play(worker.store, task)
        rate = sum(match.steps for match in matches) / max(evaluator.seconds, 1e-9)  # of the device, without pauses
        self._speed = {"steps_per_second": rate}
        worker.status = {**said, **self._speed}  # a new dict, since the heartbeat reads it
        worker.retry_while_away(lambda: worker.store.finish(lease, matches=matches))

    def others_are_training(self) -> bool:
        """Return whether a turn of training is queued or in progress, and a worker on this machine trains.

        Raises LeaseLost if the batch no longer belongs to this worker.
        """
        worker = self._worker
        if worker.lease_lost:
            raise LeaseLost("the lease of a batch of rating matches")
        if worker.stopping.is_set():
            return False
        league = worker.config.league
        jobs = none_on_error(worker.store.jobs, league, ("queued", "leased")) or ()
        workers = none_on_error(worker.store.workers, league, NEAR) or ()
        trains_here = any(TrainingTurn.kind in each.kinds for each in workers if each.host == worker.host)
        return trains_here and any(job.kind == TrainingTurn.kind for job in jobs)

    @contextmanager
    def _expendable(self) -> Iterator[None]:
        """Let a manager end the process at once while it compiles: no match of its job, if it has one, is played."""
        self._worker.expendable = True
        try:
            yield
        finally:
            self._worker.expendable = False

    def _compiled(self) -> "MatchEvaluator":
        from league.matches.evaluator import MatchEvaluator
        from league.system.arena_build import rating_batch

        worker = self._worker
        if self._evaluator is None:
            worker.status = {"doing": "compiling matches"}
            arena = worker.arena(rating_batch(worker.config).worlds)
            worker.pace = self._pace()
            self._evaluator = MatchEvaluator(worker.config, arena, worker.config.league, pace=worker.pace)
        return self._evaluator

    def _pace(self) -> "Pace | None":
        """Return the pace that limits batches to their share of a GPU; None on a CPU, which uses process priorities.

        The setting for a CPU is `workers.nice`.
        """
        from league.system.arena_build import backend
        from league.system.gpu_sharing import Pace

        if backend() != "gpu":
            return None
        config = self._worker.config
        on_same_gpu = -(-config.workers.match // max(1, len(devices.gpus())))  # workers that play matches
        share = config.rating.share
        return Pace(share if share == 1.0 else share / max(1, on_same_gpu), self.others_are_training)
