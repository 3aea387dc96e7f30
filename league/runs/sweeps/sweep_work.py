"""The runs of a sweep, worked off: some at a time, finished ones skipped, and a failure of one stops no other.

All state is in the store: a run is finished if its league has had its budget. A sweep that was killed continues
where it stopped, and several hosts with one store share a sweep, since a league that runs already is left alone.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from league.config.schema import ConfigError
from league.runs.child_run import ChildRun, RunError
from league.runs.sweeps.run_state import begun_otherwise, run_state
from league.runs.sweeps.sweep_file import SweepRun
from league.state.curriculum_stage import at_work
from league.state.liveness import leader
from league.system import devices
from storage.store import Store

LOOK = 0.2  # seconds between two looks at the runs
BEAT = 10.0  # seconds between two lines about the runs under way

Report = Callable[[str], None]


@dataclass
class Outcome:
    """The fate of runs, by name."""

    finished: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)  # name -> reason, in one line
    elsewhere: list[str] = field(default_factory=list)  # run by another process


class SweepWork:
    """The processes of a sweep. Interrupted by Ctrl-C, it lets all of them finish their iteration."""

    def __init__(self, store: str, parallel: int, report: Report):
        self._where, self._parallel, self._report = store, parallel, report
        self._running: dict[int, tuple[SweepRun, ChildRun, float]] = {}  # by slot
        self._told = time.monotonic()
        self.outcome = Outcome()

    def work_off(self, runs: Iterable[SweepRun]) -> Outcome:
        """Run leagues until none waits. Raises KeyboardInterrupt after a clean stop of those under way."""
        waiting = list(runs)
        try:
            while waiting or self._running:
                while waiting and len(self._running) < self._parallel:
                    self._begin(waiting.pop(0))
                self._look()
                time.sleep(LOOK if self._running else 0.0)
        except BaseException:
            self.stop()
            raise
        return self.outcome

    def stop(self) -> None:
        """Ask the runs under way to stop, and wait for them; a second Ctrl-C stops them at once."""
        if self._running:
            self._report(f"stopping {len(self._running)} under way; nothing is lost, the same command continues")
        while self._running:
            for _, child, _ in self._running.values():
                child.interrupt()
            try:
                for slot in [*self._running]:
                    _, child, _ = self._running[slot]
                    for _ in child.output():
                        pass
                    child.close()
                    del self._running[slot]
            except KeyboardInterrupt:
                continue

    def _begin(self, run: SweepRun) -> None:
        with Store.open(self._where, create=True, blobs=run.config.storage.blobs) as store:
            state, other = run_state(store, run.config), begun_otherwise(store, run.config)
        if state == "finished" and not other:
            self.outcome.finished.append(run.name)
            return
        if state == "runs":
            self.outcome.elsewhere.append(run.name)
            self._report(f"{run.name} is run by another process")
            return
        if other:
            self._failed(run, other)
            return
        slot = next(n for n in range(self._parallel) if n not in self._running)
        child = ChildRun(self._where, run.config, environment=device_of(slot, self._parallel))
        self._running[slot] = run, child, time.monotonic()
        self._report(f"{run.name} {'goes on' if state == 'begun' else 'begins'}")

    def _look(self) -> None:
        for slot, (run, child, began) in [*self._running.items()]:
            child.discard()
            if child.running():
                continue
            del self._running[slot]
            try:
                child.end()
            except (ConfigError, RunError) as error:
                self._failed(run, str(error))
                continue
            with Store.open(self._where, blobs=run.config.storage.blobs) as store:
                state = run_state(store, run.config)
            if state == "finished":
                self.outcome.finished.append(run.name)
                self._report(f"{run.name} has finished after {time.monotonic() - began:.0f} s")
            else:  # `league stop`
                self._failed(run, "it was stopped before its end; the same command continues")
        if self._running and time.monotonic() - self._told > BEAT:
            self._told = time.monotonic()
            self._report("; ".join(map(self._steps, [run for run, _, _ in self._running.values()])))

    def _steps(self, run: SweepRun) -> str:
        with Store.open(self._where, blobs=run.config.storage.blobs) as store:
            there = run.name in {league.name for league in store.leagues()}
            found = store.newest_checkpoints(at_work(store, run.name)).values() if there else ()
        return f"{run.name}: {max((each.step for each in found), default=0):,} steps"

    def _failed(self, run: SweepRun, why: str) -> None:
        with Store.open(self._where, blobs=run.config.storage.blobs) as store:
            led = run.name in {league.name for league in store.leagues()} and leader(store, run.name)
        if led:
            self.outcome.elsewhere.append(run.name)
        else:
            self.outcome.failed[run.name] = why
        self._report(f"{run.name} {'is run by another process' if led else f'failed: {why}'}")


def device_of(slot: int, parallel: int) -> Mapping[str, str]:
    """Return the variables that give a run a GPU of its own, where there are several runs and several GPUs."""
    found = devices.gpus()
    if parallel == 1 or len(found) < 2:
        return {}
    share = [found[i] for i in range(len(found)) if i % parallel == slot] or [found[slot % len(found)]]
    return {"CUDA_VISIBLE_DEVICES": ",".join(share)}
