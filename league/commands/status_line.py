"""The status line that a command prints while a league runs."""

import math
import os
import shutil
import socket
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from dashboards.text import clock, wrapped
from league.config.experiment import Config
from league.scheduling.progress_metrics import score_against_initial
from league.state.league_state import LeagueState
from league.state.liveness import is_dead
from league.state.void_rates import warnings as void_warnings
from matchmaking.ratings.scores import Score
from storage.records import Phase, Snapshot, Worker

NARROW = 80  # columns if the output is not a terminal
BETWEEN = " · "  # parts of a line
CLOCKS = (" left", " so far")  # ends of the parts that change although nothing happened
LONGEST_PAUSE = 60.0  # seconds without a line in a file, so that its reader knows that the league still runs
CLEAR = "\r\033[K"  # returns to the beginning of a terminal's line and clears it


@dataclass
class Ticker:
    """Printer of a status line every few seconds; on a terminal it rewrites one line, elsewhere it adds lines.

    A line that says nothing new but the time is added again only after pauses that grow to a minute.
    """

    config: Config
    every: float = 5.0
    began: float = field(default_factory=time.monotonic)
    _looked: float = 0.0
    _printed: float = 0.0
    _pause: float = 0.0  # seconds until a line that says nothing new is printed again
    _said: tuple[str, ...] = ()  # the line printed last, without its clocks
    _warned: list[str] = field(default_factory=list)  # warnings so far: kinds of void episodes, and pauses
    _rating_since: dict[int, float] = field(
        default_factory=dict
    )  # number of a phase -> time at which it was first seen

    def __call__(self, state: LeagueState, stage: str, workers: Sequence[Worker]) -> None:
        """Print the league's status, if it is time. `stage` is training, rating, ending, done or stopped."""
        live = sys.stdout.isatty()
        now = time.monotonic()
        if now - self._looked < (1.0 if live else self.every) and stage in ("training", "rating"):
            return
        self._looked = now
        self._warn(state, live)
        line = self.line(state, stage, workers, shutil.get_terminal_size().columns - 1 if live else NARROW)
        if live:
            print(f"{CLEAR}{line}", end="\n" if stage in ("done", "stopped") else "", flush=True)
        elif self._is_due(line, now) or stage in ("done", "stopped"):
            print(line, flush=True)

    def _is_due(self, line: str, now: float) -> bool:
        """Return whether a line says something new, or the growing pause since an equal one has passed."""
        said = tuple(part for part in line.split(BETWEEN) if not part.endswith(CLOCKS))
        if said != self._said:
            self._pause = self.every
        elif now - self._printed < self._pause:
            return False
        self._said, self._printed = said, now
        self._pause = min(2 * self._pause, LONGEST_PAUSE)
        return True

    def _warn(self, state: LeagueState, live: bool) -> None:
        """Warn once of many void episodes in training, of such in rating, and of each pause, with the cause."""
        new = [each for each in state.voids if each.what not in self._warned]
        why = {p.name: p.paused.strip().partition("\n")[0] for p in state.players if p.paused is not None}
        paused = [said for name, reason in why.items() if (said := f"{name} is paused: {reason}") not in self._warned]
        self._warned += [each.what for each in new] + paused
        for text in [*void_warnings(new), *paused]:
            print(f"{CLEAR if live else ''}{wrapped(f'Warning: {text}')}", flush=True)

    def line(self, state: LeagueState, stage: str, workers: Sequence[Worker], width: int = NARROW) -> str:
        """Return the league's status in at most `width` columns: the most important parts, none of them cut."""
        learners = [w.status for w in _of_this_run(workers) if "train" in w.kinds.split("+")]
        training = [said for said in learners if "steps" in said]
        past = clock(time.monotonic() - self.began)
        rated = f"{state.ladder.payoff.valid_episodes:,} rated episodes"
        if stage != "training":
            left = self._rating_left(state, stage)
            known = _against_initial(state) or _unknown(state)
            awaited = _awaited(workers) if stage == "ending" else ""
            parts = [stage, awaited, trouble_text(state), known, left, rated, f"{past} so far"]
        elif not training:
            none = "starting workers" if self.config.workers.train else "waiting for a `league worker` that trains"
            doings = [str(said["doing"]) for said in learners if "doing" in said]
            doing = next((each for each in doings if each != "waiting"), doings[0] if doings else none)
            parts = [doing, trouble_text(state), _against_initial(state), f"{past} so far", rated]
        else:
            parts = [
                _against_initial(state), self._training_left(training), trouble_text(state), *_who(training),
                f"{sum(said['steps_per_second'] for said in training):,.0f} steps/s", f"{past} so far", rated,
            ]  # fmt: skip
        return _fitting([part for part in parts if part], width)

    def _training_left(self, training: Sequence[Mapping[str, Any]]) -> str:
        """Return the time until all groups that train now have used their budgets; empty without a budget."""
        budget = self.config.budget
        left = []
        for said in training:
            by_clock = budget.train_seconds - said["seconds"]
            by_steps = math.inf
            if budget.steps is not None and said["steps_per_second"]:
                by_steps = (budget.steps - said["steps"]) / said["steps_per_second"]
            left.append(max(0.0, min(by_clock, by_steps)))
        return f"{clock(max(left))} left" if max(left) < math.inf else ""

    def _rating_left(self, state: LeagueState, stage: str) -> str:
        """Return the remaining time of the rating budget by the phase in the store; empty without a budget."""
        timed = [p for p in state.phases.values() if p.until.get("seconds") is not None]
        if stage != "rating" or not timed:
            return ""
        phase: Phase = max(timed, key=lambda p: p.number)
        since = self._rating_since.setdefault(phase.number, time.monotonic())
        left = phase.until["seconds"] - (time.monotonic() - since)
        return f"{clock(left)} left" if left > 0.0 else "the last batch is being played"


def _awaited(workers: Sequence[Worker]) -> str:
    """Return what workers finish before the league ends: a batch of matches may take half a minute."""
    doing = [str(w.status.get("doing", "")) for w in _of_this_run(workers)]
    jobs = {"training": "an iteration", "rating": "a batch of matches"}
    found = [text for job, text in jobs.items() if any(said.startswith(job) for said in doing)]
    return f"finishing {' and '.join(found)}" if found else ""


def _of_this_run(workers: Sequence[Worker]) -> list[Worker]:
    """Return the workers of this run: their processes exist, and began after the manager that asks.

    The store still has the last status of a process that was killed.
    """
    mine = f"{socket.gethostname()}:{os.getpid()}:"
    began = next((w.started for w in workers if w.kinds == "manager" and w.id.startswith(mine)), -math.inf)
    return [w for w in workers if not is_dead(w.id) and w.started >= began]


def _who(training: Sequence[Mapping[str, Any]]) -> list[str]:
    """Describe the learning players, with their progress and the steps of their group."""
    if len(training) > 1:
        return [f"{len(training)} groups learn", f"{sum(said['steps'] for said in training):,} steps"]
    (said,) = training
    return [f"{'+'.join(said['learners'])} learn", f"iteration {said['iteration']}", f"{said['steps']:,} steps"]


def _against_initial(state: LeagueState) -> str:
    """Return the score against initial of each player's last snapshot with such a score, and name newer ones without.

    In an arena of one team the score is the success rate. For many players the range is given.
    """
    found = {player.name: _last_scored(state, player.name) for player in state.players}
    scored = {snapshot.name: score for snapshot, score in filter(None, found.values())}
    newest = [s for s in state.newest_snapshots if not s.initial]
    waiting = [s.name for s in newest if s.name not in scored]
    what = "success" if state.one_team else "vs initial"
    if not scored:
        return ""
    if len(scored) > 2:
        low, high = min(s.score for s in scored.values()), max(s.score for s in scored.values())
        many = sum(s.suspect for s in scored.values())
        late = f" ({len(waiting)} newest not yet)" if waiting else ""
        void = f" ({many} with many voids)" if many else ""
        return f"newest rated of {len(scored)} players {100 * low:.0f}-{100 * high:.0f} % {what}{void}{late}"
    late = f" ({', '.join(waiting) if len(waiting) <= 2 else f'{len(waiting)} newest'} not yet)" if waiting else ""
    return f"{', '.join(f'{name} {_per_cent(score)}' for name, score in scored.items())} {what}{late}"


def _per_cent(score: Score) -> str:
    """Return a score in per cent, with the share of void episodes if it makes the score suspect."""
    void = f" ({100 * score.voids / (score.games + score.voids):.0f} % void)" if score.suspect else ""
    return f"{100 * score.score:.0f} %{void}"


def _unknown(state: LeagueState) -> str:
    """Return the message that no snapshot has a score against initial yet."""
    newest = [s.name for s in state.newest_snapshots if not s.initial]
    whose = f"{' and '.join(newest)}: " if 0 < len(newest) <= 2 else ""
    return f"{whose}{'success' if state.one_team else 'score vs initial'} not known yet"


def _last_scored(state: LeagueState, player: str) -> tuple[Snapshot, Score] | None:
    """Return a player's last snapshot with a score against initial, or in an arena of one team a success rate."""
    for snapshot in reversed(state.history(player)):
        if state.one_team:
            score = state.ladder.success(snapshot.name)
        else:
            score = score_against_initial(state.ladder, snapshot, state.snapshots, state.players)
        if score is not None and score.games and not snapshot.initial:
            return snapshot, score
    return None


def trouble_text(state: LeagueState) -> str:
    """Name the parts without which the league continues; empty without faults. `league status` has the reasons."""
    jobs = sum(job.state == "failed" for job in state.jobs)
    paused = [player.name for player in state.players if player.paused is not None]
    parts = [f"{jobs} job{'s' * (jobs > 1)} set aside"] if jobs else []
    parts += [f"{' and '.join(paused)} paused"] if paused else []
    return ", ".join(parts + [each.short for each in state.voids])


def _fitting(parts: Sequence[str], width: int) -> str:
    """Return as many parts as fit, in order; a part that does not fit is left out as a whole."""
    line = ""
    for part in parts:
        longer = f"{line}{BETWEEN}{part}" if line else part
        if len(longer) <= width:
            line = longer
    return line
