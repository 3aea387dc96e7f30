"""The processes that get the next stage of a curriculum ready, while the present stage trains.

One builds the stage's arena, imports all and waits; it becomes the stage's first train worker. On a machine with cores
to spare it starts when players have learnt, elsewhere when the stage has ended and its workers end, so that it takes
neither time nor memory from them.

The other one compiles, with cores to spare on a GPU. Warp's kernels go into Warp's cache and the training rollout into
XLA's, where the stage's own worker finds them. XLA's key holds the device, and its autotuning measures on it, so the
process opens the GPU that the worker will use. It simulates no world, and where the GPU is nearly full it does nothing.

Nobody waits for that process. Whatever it has not compiled, the stage compiles itself. It has low priority and few
cores, and ends with its parent, even if that was killed. Matches are left to the worker that plays them.
"""

import io
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from arenas.physics.cpu import cores
from league.commands.cli import one_line
from league.config import experiment as configuration
from league.config.experiment import Config
from league.config.run_spec import RunSpec
from league.runtime.manager import RunState
from league.runtime.preflight import prepare_ahead
from league.runtime.warm_worker import WarmWorker
from league.scheduling import curriculum
from league.state.league_state import LeagueState
from league.system import devices, environment, exit_codes, provenance

if TYPE_CHECKING:
    from arenas.arena import Arena

ENGINES = ("warp", "jax")
"""Engines that compile for many seconds and whose programs are kept; XLA keeps none that calls the C engine."""
CORES_OF_A_WORKER = 4  # that are left to each worker of the league, and more than half of what remains
MOST = 8  # cores that the process uses
NICE = 19
AUTOGROUP = Path("/proc/self/autogroup")
LONGEST = 600  # seconds after which the process ends itself
PATIENCE = 5.0  # seconds in which a process that was killed has ended


def cores_to_spare(config: Config) -> int:
    """Return the number of cores for compiling beside a league's workers; 0 if there are too few."""
    workers = config.workers.train + config.workers.match
    return max(0, min(MOST, (cores() - CORES_OF_A_WORKER * workers) // 2))


# In the manager's process --------------------------------------------------------------------------------------------


class NextStage:
    """The processes for the stages of a curriculum, one stage after the other; `end` ends them.

    `process` compiles, and `prepared` waits to become a worker: at first the process that has checked the curriculum.
    """

    def __init__(self, config: Config, store: str, prepared: WarmWorker | None = None):
        self._config, self._store = config, store
        self._last = -1  # the stage for which a process compiled last
        self.process: subprocess.Popen[str] | None = None
        self.prepared = prepared

    def watch(self, number: int, engine: str) -> Callable[[LeagueState, RunState], None]:
        """Return a function that is to be called with the states of stage `number`. All stages have the same engine.

        Compiling for the stage after it begins when its players have learnt: until then it compiles itself.
        """

        def look(state: LeagueState, activity: RunState) -> None:
            self._tell_failure()
            if all(at.iteration == 0 for at in state.checkpoints.values()):
                return
            if self._last <= number:
                self._end_compiling()  # one that still compiles for this stage is of no more use
                self._last = number + 1
                self._start(number + 1, engine)
            if self.prepared is None and number + 1 < len(self._config.stages):
                self._prepare_after(number, state, activity)

        return look

    def take_prepared(self) -> WarmWorker | None:
        """Return the process that waits to become a worker, if there is one; the caller ends it."""
        prepared, self.prepared = self.prepared, None
        return prepared

    def end(self) -> None:
        """End the processes at once, if there are any."""
        self._end_compiling()
        if prepared := self.take_prepared():
            prepared.end()

    def _prepare_after(self, number: int, state: LeagueState, activity: RunState) -> None:
        """Start the process for the next stage if it is time for that."""
        stage, following = (configuration.stage(self._config, n) for n in (number, number + 1))
        has_ended = activity == "ending" and curriculum.ended(stage, state) is not None  # and was not stopped
        if has_ended or cores_to_spare(stage):
            with suppress(OSError):  # no room for a process now: the stage starts one when it begins
                self.prepared = prepare_ahead(RunSpec.of(self._store, following), following)

    def _end_compiling(self) -> None:
        if self.process is not None:
            self.process.kill()
            self._close()

    def _start(self, number: int, engine: str) -> None:
        if number >= len(self._config.stages) or engine not in ENGINES:
            return
        stage = configuration.stage(self._config, number)
        spare = cores_to_spare(stage)
        if not spare:
            return
        try:
            self.process = subprocess.Popen(
                provenance.command("league.commands.run.next_stage"), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, text=True, errors="replace",
                start_new_session=True,  # Ctrl-C is for the parent
            )  # fmt: skip
        except OSError as error:
            self._tell(str(error))
            return
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):  # it has ended already, which is told later
            request = {"config": configuration.dumps(stage), "cores": spare, "nice": NICE}
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()

    def _tell_failure(self) -> None:
        """Print one line if the process has failed."""
        if self.process is None or (code := self.process.poll()) is None:
            return
        why = self._close() or f"the process that compiled for it ended with exit code {code}"
        if code:
            self._tell(why)

    def _tell(self, why: str) -> None:
        name = self._config.stages[self._last].name
        print(f"league: stage {name} compiles when it begins: {why}", file=sys.stderr, flush=True)

    def _close(self) -> str:
        """Return the line that a process that ends has printed; one that hangs although it was killed is left alone."""
        process, self.process = self.process, None
        assert process is not None
        with suppress(BrokenPipeError, subprocess.TimeoutExpired):
            return process.communicate(timeout=PATIENCE)[0].strip()
        return ""


# In the process that compiles ----------------------------------------------------------------------------------------


def compile_stage(config: Config) -> None:
    """Compile a stage's Warp kernels and its training rollout into the caches. Raises what fails."""
    from league.system.arena_build import build, worlds

    sized = replace(config, training=replace(config.training, worlds=worlds(config)))  # as the manager does
    count = worlds(config) // config.training.devices
    arena = build(sized, count)
    if arena.engine.name not in ENGINES:
        return
    arena.engine.compile()
    if config.training.devices == 1:  # of several devices each has a process, whose part depends on all of them
        compile_rollout(sized, arena, count)


def compile_rollout(config: Config, arena: "Arena", count: int) -> None:
    """Compile the first rollout of a league for `count` worlds, whose players are made in a store for this purpose.

    Only the shapes of policies matter for it, which the settings decide, and not those from which players continue.
    """
    from league.runtime.bootstrap import create
    from league.scheduling.turn_scheduler import next_turns
    from league.state.jobs import TrainingTurn, decode
    from league.training.trainer import Trainer
    from storage.store import Store

    config = config.afresh
    with tempfile.TemporaryDirectory(prefix="robot-league-") as folder, Store.open(folder, create=True) as store:
        create(store, config, arena)
        trainer = Trainer(config, arena, store.players(config.league), count)
        while True:
            plan = next_turns(config, LeagueState.of(store, config.league))
            store.queue(plan.jobs, plan.phases)
            claimed = store.claim(config.league, (TrainingTurn.kind,), "compiling", 3600.0)
            if claimed is None:  # nobody learns before matches are played
                return
            lease, job = claimed
            turn = decode(job)
            assert isinstance(turn, TrainingTurn)
            if turn.iterations:
                trainer.compile(store, turn)
                return
            for _ in trainer.turn(store, turn, lambda: False):
                pass
            trainer.commit(store, lease, turn)


def main() -> int:
    """Compile what the request on stdin asks for; print the reason of a failure as one line."""
    signal.alarm(LONGEST)  # ends also a process that hangs in a compiler
    stdin = io.FileIO(0, closefd=False)
    request = json.loads(stdin.readline())
    threading.Thread(target=_end_with, args=(stdin,), daemon=True).start()
    _give_way(request["cores"], request["nice"])
    environment.prepare()
    config = configuration.loads(request["config"], "settings")
    if config.training.devices == 1:
        devices.take(0)  # as the worker does
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as answer:
        os.dup2(2, 1)  # libraries print greetings on stdout
        try:
            if devices.has_room():
                compile_stage(config)
        except Exception as error:
            print(one_line(error), file=answer)
            return exit_codes.NO
    return exit_codes.DONE


def _give_way(most: int, nice: int) -> None:
    """Lower the priority of this process by `nice`, and use so many cores."""
    os.nice(nice)
    with suppress(
        OSError
    ):  # Linux shares cores among sessions before niceness counts, and this one is its own (sched(7))
        AUTOGROUP.write_text(str(nice))
    if hasattr(os, "sched_setaffinity"):  # libraries make as many threads
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-most:])


def _end_with(stdin: io.FileIO) -> None:
    """End this process when the one that started it has gone."""
    while stdin.read(1):
        pass
    os._exit(exit_codes.NO)


if __name__ == "__main__":
    sys.exit(main())
