"""A search over a sweep's ranges by Optuna, which proposes a point and gets the objective of its runs.

Optuna keeps nothing: the trials of an earlier call are read from the leagues of the store, so a search that was killed
continues.
"""

import math
import statistics
from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any

from league.config.schema import ConfigError
from league.queries.query import Open
from league.runs.sweeps.objective import objective, too_early
from league.runs.sweeps.run_state import begun_otherwise, flat_settings, run_state
from league.runs.sweeps.sweep_file import Sweep, SweepRun
from league.state.curriculum_stage import at_work
from storage.store import Store

DIGITS = 3  # of a searched number: its run has it in its name


class Search:
    """The search of one sweep.

    Raises ConfigError if Optuna is not installed, or if a league of the sweep was begun with other settings than those
    that are searched.
    """

    def __init__(self, sweep: Sweep, store: str):
        try:
            optuna: Any = import_module("optuna")
        except ImportError as error:
            need = f"a search over ranges needs Optuna ({error}): pip install 'robot-league[sweep]'"
            raise ConfigError(("sweep", "trials"), need) from None
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self._optuna, self.sweep, self._where = optuna, sweep, store
        self.distributions = self._distributions()
        self.study = optuna.create_study(direction="maximize")
        self._unfinished = self._earlier()

    def rounds(self, parallel: int) -> Iterator[list[tuple[Any, list[SweepRun]]]]:
        """Yield the next trials with their runs, some at a time; call `tell` of each before the next round."""
        for params in self._unfinished:
            self.study.enqueue_trial(params)
        seed = self.sweep.settings.seeds[0] + len(self.study.trials)  # else a later call would ask for the same points
        self.study.sampler = self._optuna.samplers.TPESampler(seed=seed)
        assert self.sweep.settings.trials is not None
        each = len(self.sweep.settings.seeds)
        while (left := self.sweep.settings.trials - len(self.study.trials) + self._waiting()) > 0:
            asked = [self.study.ask(self.distributions) for _ in range(min(left, max(1, parallel // each)))]
            yield [(trial, self.sweep.of_cell(self._cell(trial.params))) for trial in asked]

    def tell(self, trial: Any, runs: list[SweepRun]) -> float | None:
        """Tell Optuna the mean objective of a trial's runs, and return it; None if a run failed or is not rated."""
        values = [self._value(run) for run in runs]
        known = [value for value in values if value is not None and not math.isnan(value)]
        if len(known) < len(runs):
            self.study.tell(trial, state=self._optuna.trial.TrialState.FAIL)
            return None
        found = statistics.fmean(known)
        self.study.tell(trial, found)
        return found

    def too_early(self, runs: list[SweepRun]) -> str:
        """Return the remark of the first run whose objective is one of early snapshots; else an empty text."""
        for run in runs:
            with Store.open(self._where, blobs=run.config.storage.blobs) as store:
                if found := too_early(Open(store, at_work(store, run.name)), self.sweep.settings.objective):
                    return f" {found}"
        return ""

    def best(self) -> tuple[dict[str, Any], float] | None:
        """Return the best trial's cell and its objective; None before the first."""
        complete = self.study.get_trials(states=(self._optuna.trial.TrialState.COMPLETE,))
        if not complete:
            return None
        found = max(complete, key=lambda trial: trial.value if trial.value is not None else -math.inf)
        return self._cell(found.params), float(found.value or 0.0)

    def _waiting(self) -> int:
        return len(self.study.get_trials(states=(self._optuna.trial.TrialState.WAITING,)))

    def _cell(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """Return a trial's cell: numbers with few digits, and categories by their place in the grid."""
        cell: dict[str, Any] = {}
        for key, value in params.items():
            if key in self.sweep.grid:
                cell[key] = self.sweep.grid[key][int(value)]
            elif isinstance(value, float):
                over, short = self.sweep.ranges[key], float(f"{value:.{DIGITS}g}")
                cell[key] = min(max(short, over.low), over.high)
            else:
                cell[key] = value
        return cell

    def _distributions(self) -> dict[str, Any]:
        kinds = self._optuna.distributions
        found: dict[str, Any] = {
            key: kinds.CategoricalDistribution(tuple(range(len(values)))) for key, values in self.sweep.grid.items()
        }
        for key, over in self.sweep.ranges.items():
            whole = type(over.low) is int and type(over.high) is int
            kind = kinds.IntDistribution if whole else kinds.FloatDistribution
            found[key] = kind(over.low, over.high, log=over.log)
        return found

    def _earlier(self) -> list[dict[str, Any]]:
        """Add the finished trials of the store to the study, and return the parameters of the unfinished ones.

        Raises ConfigError for a league with other settings: its objective says nothing about those of this search.
        """
        unfinished = []
        for params in self._stored():
            runs = self.sweep.of_cell(self._cell(params))
            for run in runs:
                with Store.open(self._where, blobs=run.config.storage.blobs) as store:
                    if other := begun_otherwise(store, run.config):
                        raise ConfigError(("sweep", "name"), f"league {run.name}: {other}")
            values = [self._value(run) for run in runs]
            if any(value is None for value in values):
                unfinished.append(params)
                continue
            known = [value for value in values if value is not None and not math.isnan(value)]
            state = self._optuna.trial.TrialState
            done = len(known) == len(values)
            self.study.add_trial(
                self._optuna.trial.create_trial(
                    params=params, distributions=self.distributions, value=statistics.fmean(known) if done else None,
                    state=state.COMPLETE if done else state.FAIL,
                )
            )  # fmt: skip
        return unfinished

    def _stored(self) -> list[dict[str, Any]]:
        """Return the parameters of the sweep's leagues in the store, each once, in the order in which they began."""
        found: list[dict[str, Any]] = []
        with Store.open(self._where, create=True) as store:
            texts = [each.config for each in store.leagues() if each.name.startswith(f"{self.sweep.name}.")]
        for text in texts:
            settings, params = flat_settings(text), {}
            for key, distribution in self.distributions.items():
                value = settings.get(key)
                if key in self.sweep.grid:
                    value = self.sweep.grid[key].index(value) if value in self.sweep.grid[key] else None
                if value is not None and distribution._contains(distribution.to_internal_repr(value)):
                    params[key] = value
            if len(params) == len(self.distributions) and params not in found:
                found.append(params)
        return found

    def _value(self, run: SweepRun) -> float | None:
        """Return the objective of a run that has finished; None otherwise, and for one that has other settings."""
        with Store.open(self._where, blobs=run.config.storage.blobs) as store:
            if run_state(store, run.config) != "finished" or begun_otherwise(store, run.config):
                return None
            return objective(Open(store, at_work(store, run.name)), self.sweep.settings.objective)
