"""What `league run` prints: a line while it runs; at its end who is better, how sure that is, what to type next."""

import math
import os
import shutil
import socket
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from league.commands.ladder import ratings_table
from league.config.experiment import Config
from league.liveness import is_dead
from league.measures import newest_snapshots, score_against_initial, yardsticks
from league.query import score_text
from league.standing import Standing
from league.words import clock
from matchmaking.payoff import Score
from storage.records import Phase, Snapshot, Worker

NEXT = """Next:
  league ratings     who is better, and how sure that is
  league watch       a recorded match in 3D (league watch --shot match.png where there is no display)
  league run         go on training from where it stopped"""
NARROW = 80  # columns where the output is no terminal


@dataclass
class Ticker:
    """Prints a status line every few seconds; on a terminal it rewrites one line, elsewhere it adds lines."""

    config: Config
    every: float = 5.0
    began: float = field(default_factory=time.monotonic)
    _told: float = 0.0
    _rating_since: dict[int, float] = field(default_factory=dict)  # number of a phase -> when it was first seen

    def __call__(self, standing: Standing, stage: str, workers: Sequence[Worker]) -> None:
        """Tell how the league stands, if it is time. `stage` is training, rating, done or stopped."""
        live = sys.stdout.isatty()
        now = time.monotonic()
        if now - self._told < (1.0 if live else self.every) and stage in ("training", "rating"):
            return
        self._told = now
        line = self.line(standing, stage, workers, shutil.get_terminal_size().columns - 1 if live else NARROW)
        if live:
            print(f"\r\033[K{line}", end="" if stage in ("training", "rating") else "\n", flush=True)
        else:
            print(line, flush=True)

    def line(self, standing: Standing, stage: str, workers: Sequence[Worker], width: int = NARROW) -> str:
        """How the league stands in at most `width` columns: the most important parts, each of them whole."""
        learners = [w.status for w in _of_this_run(workers) if w.kinds == "train"]
        training = [said for said in learners if "steps" in said]
        past = clock(time.monotonic() - self.began)
        games = standing.ladder.payoff.home.sum() + standing.ladder.payoff.away.sum()
        rated = f"{games + standing.ladder.payoff.trials[:, :2].sum():,} rated episodes"
        if stage != "training":
            left = self._rating_left(standing, stage)
            parts = [stage, _against_initial(standing), left, _trouble(standing), rated, f"{past} so far"]
        elif not training:
            doing = next((str(said["doing"]) for said in learners if "doing" in said), "starting workers")
            parts = [doing, _against_initial(standing), _trouble(standing), f"{past} so far", rated]
        else:
            parts = [
                _against_initial(standing), self._training_left(training), _trouble(standing), *_who(training),
                f"{sum(said['steps_per_second'] for said in training):,.0f} steps/s", f"{past} so far", rated,
            ]  # fmt: skip
        return _fitting([part for part in parts if part], width)

    def _training_left(self, training: Sequence[Mapping[str, Any]]) -> str:
        """The time until the last of the groups that train now has had its budget; empty without one."""
        budget = self.config.budget
        left = []
        for said in training:
            by_clock = budget.train_seconds - said["seconds"]
            by_steps = math.inf
            if budget.steps is not None and said["steps_per_second"]:
                by_steps = (budget.steps - said["steps"]) / said["steps_per_second"]
            left.append(max(0.0, min(by_clock, by_steps)))
        return f"{clock(max(left))} left" if max(left) < math.inf else ""

    def _rating_left(self, standing: Standing, stage: str) -> str:
        """The time that is left of the rating budget, as the phase in the store has it; empty without one."""
        timed = [p for p in standing.phases.values() if p.until.get("seconds") is not None]
        if stage != "rating" or not timed:
            return ""
        phase: Phase = max(timed, key=lambda p: p.number)
        since = self._rating_since.setdefault(phase.number, time.monotonic())
        return f"{clock(max(0.0, phase.until['seconds'] - (time.monotonic() - since)))} left"


def summary(config: Config, standing: Standing) -> str:
    """The ladder, each newest snapshot against its yardsticks, and the next things to type."""
    table = ratings_table(standing.ladder, standing.snapshots, standing.players, config.rating.void_limit)
    trouble = [f"{told}: `league status` tells why."] if (told := _trouble(standing)) else []
    return "\n\n".join([table, *_yardsticks(config, standing), *_who_is_better(standing), *trouble, NEXT])


def _of_this_run(workers: Sequence[Worker]) -> list[Worker]:
    """Workers whose words are news: their processes exist, and began after the manager that asks.

    A process that was killed has left its last words in the store.
    """
    mine = f"{socket.gethostname()}:{os.getpid()}:"
    began = next((w.started for w in workers if w.kinds == "manager" and w.id.startswith(mine)), -math.inf)
    return [w for w in workers if not is_dead(w.id) and w.started >= began]


def _who(training: Sequence[Mapping[str, Any]]) -> list[str]:
    """Who learns, how far they are, and how many steps that took."""
    if len(training) > 1:
        return [f"{len(training)} groups learn", f"{sum(said['steps'] for said in training):,} steps"]
    (said,) = training
    return [f"{'+'.join(said['learners'])} learn", f"iteration {said['iteration']}", f"{said['steps']:,} steps"]


def _against_initial(standing: Standing) -> str:
    """Score against initial of each player's newest snapshot that has one, or their range; success of one team."""
    found: dict[str, Score] = {}
    for player in standing.players:
        for snapshot in reversed(standing.history(player.name)):
            if standing.one_team:
                score = standing.ladder.success(snapshot.name)
            else:
                score = score_against_initial(standing.ladder, snapshot, standing.snapshots, standing.players)
            if score is not None and score.games and not snapshot.initial:
                found[player.name] = score
                break
    what = "success" if standing.one_team else "vs initial"
    if not found:
        return ""
    if len(found) > 2:
        low, high = min(s.score for s in found.values()), max(s.score for s in found.values())
        return f"{len(found)} players {100 * low:.0f}-{100 * high:.0f} % {what}"
    return f"{', '.join(f'{name} {100 * score.score:.0f} %' for name, score in found.items())} {what}"


def _trouble(standing: Standing) -> str:
    """What the league goes on without; empty where nothing is amiss. `league status` has the reasons."""
    jobs = sum(job.state == "failed" for job in standing.jobs)
    paused = [player.name for player in standing.players if player.paused is not None]
    parts = [f"{jobs} job{'s' * (jobs > 1)} set aside"] if jobs else []
    parts += [f"{' and '.join(paused)} paused"] if paused else []
    return ", ".join(parts)


def _fitting(parts: Sequence[str], width: int) -> str:
    """As many of the parts as fit, the first ones first; a part that does not fit is left out as a whole."""
    line = ""
    for part in parts:
        longer = f"{line} · {part}" if line else part
        if len(longer) <= width:
            line = longer
    return line


def _who_is_better(standing: Standing) -> list[str]:
    """How sure it is that the best player's newest snapshot is stronger than the next one's, of those of one roster."""
    known = [s for s in newest_snapshots(standing) if standing.ladder.known(s.name)]
    lines = []
    ratings = standing.ladder.ratings
    for roster in dict.fromkeys(s.roster for s in known):
        alike = sorted((s for s in known if s.roster == roster), key=lambda s: -ratings.elo[ratings.index(s.name)])
        if len(alike) < 2:
            continue
        first, second = alike[:2]
        if first.digest == second.digest:  # a copy, as ladder makes them: their ratings differ by chance alone
            lines.append(f"{first.name} and {second.name} are the same policy.")
        else:
            sure = ratings.likelihood_of_superiority(first.name, second.name)
            lines.append(f"{first.name} is stronger than {second.name} with probability {100 * sure:.0f} %.")
    return lines


def _yardsticks(config: Config, standing: Standing) -> list[str]:
    """For each newest snapshot its score against all by whom progress is told, or how often it succeeds alone."""
    blocks = []
    for snapshot in newest_snapshots(standing):
        if standing.one_team and standing.ladder.tried(snapshot.name):
            blocks.append(f"{snapshot.name} succeeds: {score_text(standing.ladder.success(snapshot.name))}")
        lines = [f"{snapshot.name} against"]
        for other in yardsticks(config, standing, snapshot):
            score = standing.ladder.score(snapshot.name, other.name)
            if score.games:
                lines.append(f"  {_title(snapshot.player, other):<32} {score_text(score)}")
        if len(lines) > 1:
            blocks.append("\n".join(lines))
    return blocks


def _title(player: str | None, other: Snapshot) -> str:
    if other.script:
        return other.name
    own = "its own " if other.player == player else ""
    return f"{own}{other.name} ({clock(other.seconds)} of training)"
