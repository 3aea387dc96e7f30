"""`league status`: whether it runs, who learns and what ends that, who is paused, what was set aside, who works."""

import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from dashboards.tables import Column, render
from dashboards.terminal import gauge, is_lit, spark, styles
from league import devices, population
from league.commands.options import Where, parse
from league.config.sections import Budget, Rating
from league.course import course
from league.liveness import leader, processes
from league.lives import Life, life
from league.query import Open, score_text
from league.share import words
from league.standing import Standing, turn_scores
from league.words import clock
from matchmaking.payoff import Score
from matchmaking.roles import FIXED
from matchmaking.schedule import Kind, Learnt, Schedule, remaining
from storage.records import Checkpoint, Job, JobState, Phase, Player, Worker
from storage.store import Store

STATES: Mapping[JobState, str] = {
    "queued": "queued",
    "leased": "being worked on",
    "done": "done",
    "failed": "set aside",
}
PLAYERS = (
    Column("player", whole=True), "team", "role", "iteration", "steps", Column("now", whole=True),
    Column("trained", whole=True), "group",
)  # fmt: skip
SCORE = Column("course", "score", whole=True)
LOCKED = "The store is locked by some process, and all others wait: one that was stopped or hangs in a write?"
RECENT = 200
"""Iterations over which a terminal shows the score in training."""
WORKERS = (
    "worker", "doing", "learners", "iteration", Column("steps/s", decimals=0), Column("job", whole=True),
    Column("lease s", decimals=0), Column("seen s ago", decimals=1),
)  # fmt: skip


def status(args: list[str]) -> int:
    """Tell how a league stands."""
    options = parse(Where, args, "status", "Whether it runs, who learns, who is paused, which jobs wait or failed.")
    with options.open() as opened:
        print(report(opened, whole_errors="--debug" in sys.argv, lit=is_lit()))
    return 0


@dataclass(frozen=True)
class Facts:
    """How a league stands: rows of players and workers, and lines about all else."""

    league: str
    runs: str  # by whom; empty for a league that is stopped
    counts: Mapping[JobState, int]  # jobs in each of STATES
    players: Sequence[dict]
    share: str  # of the devices that rating matches have taken
    stages: Sequence[str]
    phases: Sequence[str]
    lives: Sequence[str]  # of players whose role has them
    population: Sequence[str]  # of players that may copy each other
    paused: Sequence[str]
    again: Sequence[str]  # jobs that failed and are tried again
    failed: Sequence[str]
    workers: Sequence[dict]
    progress: Mapping[str, float]  # of each group's training, of what there is a budget for: 0 to 1
    machine: str  # what is left of this one

    @property
    def jobs(self) -> str:
        """The jobs, counted, in a line."""
        return ", ".join(f"{n:,} {STATES[state]}" for state, n in self.counts.items())


def facts(opened: Open, whole_errors: bool = False) -> Facts:
    """A league's status; of an error its first line, or all of it."""
    store, league = opened.store, opened.league
    players, checkpoints, phases = store.players(league), store.newest_checkpoints(league), store.phases(league)
    working = [worker for worker in processes(store, league) if worker.kinds != "manager"]
    counts, now = store.job_counts(league), store.now()
    jobs = store.jobs(league, ("queued", "leased", "failed"))
    runs, scores = _running(store, league, working), turn_scores(store, phases)
    return Facts(
        league, runs, {state: counts.get(state, 0) for state in STATES},
        [_player(p, checkpoints.get(p.name), phases.get(p.group), bool(runs)) for p in players],
        f"Rating: {_share(opened, players, checkpoints)}",
        _stages(store, league),
        [_phase(phase, checkpoints, scores) for phase in phases.values() if phase.learners],
        _lives(opened, players, checkpoints),
        _population(opened, players, checkpoints),
        [f"{p.name}: {_error(p.paused, whole_errors)}" for p in players if p.paused is not None],
        [_failed(job, whole_errors) for job in jobs if job.failures and job.state != "failed"],
        [_failed(job, whole_errors) for job in jobs if job.state == "failed"],
        [_worker(worker, {job.holder: job for job in jobs if job.state == "leased"}, now) for worker in working],
        _progress(opened, Standing(players, checkpoints=checkpoints)),
        _machine(store),
    )  # fmt: skip


def report(opened: Open, whole_errors: bool = False, lit: bool = False) -> str:
    """A league's status as text; of an error its first line, or all of it. Where `lit`, for a terminal."""
    found = facts(opened, whole_errors)
    players, columns, progress = found.players, PLAYERS, []
    if lit:
        players, columns = _lit(opened, players), (*PLAYERS[:5], SCORE, *PLAYERS[5:])
        progress = [f"{name:<12} {gauge(share)}" for name, share in found.progress.items()]
    parts = [
        *_listed("Curriculum", found.stages),
        f"League {found.league}: {found.runs or 'stopped'}\nJobs: {found.jobs}",
        *([LOCKED] if found.runs and opened.store.locked() else []),
        render(players, columns, lit=lit),
        *_listed("Training budget", progress),
        found.share,
        *_listed("Phases", found.phases),
        *_listed("Lives", found.lives),
        *_listed("Population", found.population),
        *_listed("Paused", found.paused),
        *_listed("Tried again", found.again),
        *_listed("Set aside", found.failed),
        *([render(found.workers, WORKERS, lit=lit)] if found.workers else []),
        found.machine,
    ]
    return "\n\n".join(parts)


def _stages(store: Store, league: str) -> list[str]:
    """The stages of the curriculum that the league belongs to; only where it does are settings read."""
    if course(store, league) is None:
        return []
    from league import curriculum

    return curriculum.report(store, league)


def _running(store: Store, league: str, working: Sequence[Worker]) -> str:
    """Who runs it; empty for a league that is stopped.

    A manager that was killed leads until its lease expires, unless it can be seen that its process is gone.
    """
    manager = leader(store, league)
    if manager is not None:
        return f"running, managed by {manager}"
    return f"stopping, {len(working)} workers still finish what they do" if working else ""


def _player(player: Player, at: Checkpoint | None, phase: Phase | None, runs: bool) -> dict:
    learns = phase is not None and player.name in phase.learners
    iteration, steps, seconds = (at.iteration, at.step, at.seconds) if at else (0, 0, 0.0)
    now = (
        "paused"
        if player.paused is not None
        else "fixed"
        if player.role == FIXED.name
        else "learns"
        if learns
        else "rests"
        if phase
        else "not begun"
    )
    if player.setbacks:
        now += f", {player.setbacks} setback{'s' * (player.setbacks > 1)}"
    return {
        "player": player.name, "team": player.team, "role": player.role, "group": player.group,
        "iteration": iteration, "steps": steps, "trained": clock(seconds),
        "now": now if runs or player.paused is not None else "stopped",
    }  # fmt: skip


def _phase(phase: Phase, checkpoints: Mapping[str, Checkpoint], scores: Mapping[str, Score]) -> str:
    """Who learns, since when, and what will end it."""
    at = {name: Learnt(at.iteration, at.step) for name, at in checkpoints.items()}
    left = remaining(phase, at)
    since = ", ".join(dict.fromkeys(str(phase.since.get(name, 0)) for name in phase.learners))
    if left is None:
        end = "nothing ends it"
    elif "step" in phase.until:
        end = f"it ends at step {phase.until['step']:,}, {left:,} are left"
    else:
        end = f"it ends after {phase.until['iterations']} iterations, {left} are left"
    if "score" in phase.until:
        score = scores[phase.learners[0]]
        now = f"it scores {score_text(score)}" if score.games else "no episode has ended yet"
        sure = f"surely scores above {100 * phase.until['score']:g} %: {now}"
        over = score.low > phase.until["score"]
        end = f"its turn is over, for it {sure}" if over else f"{end}, or before that when it {sure}"
    verb = "learns" if len(phase.learners) == 1 else "learn"
    return f"group {phase.group}: {' and '.join(phase.learners)} {verb} since iteration {since}; {end}"


def _lives(opened: Open, players: Sequence[Player], checkpoints: Mapping[str, Checkpoint]) -> list[str]:
    """What ends the lives of those who have one by their role."""
    role_of = opened.roles()
    with_lives = [p for p in players if p.name in checkpoints and role_of(p.role).has_lives]
    if not with_lives:
        return []
    store, league = opened.store, opened.league
    standing = Standing(players, store.snapshots(league), meetings=store.meetings(league))
    found = [(p, life(role_of(p.role), standing, p, checkpoints[p.name].step)) for p in with_lives]
    return [_life(player, each) for player, each in found if each is not None]


def _population(opened: Open, players: Sequence[Player], checkpoints: Mapping[str, Checkpoint]) -> list[str]:
    """Who has which hyperparameters, and has copied whom."""
    if not population.ready_after(opened):
        return []
    standing = Standing(players, opened.store.snapshots(opened.league), checkpoints)
    return [f"{name}: {told}" for name, told in population.words(opened, standing).items()]


def _life(player: Player, now: Life) -> str:
    """Since when it lasts, what will end it, and what follows."""
    role, ends = now.role, []
    if role.win_rate is not None:
        least = min(now.scores.items(), key=lambda item: item[1].low, default=None)
        told = "nobody is there yet" if least is None else f"least sure against {least[0]}, {score_text(least[1])}"
        ends.append(f"it surely scores above {100 * role.win_rate:g} % against all {len(now.scores)} it meets ({told})")
    if role.timeout is not None:
        ends.append(f"after {role.timeout:,} steps ({now.left:,} are left)")
    told = f"{player.name} ({role.name}) since {now.since.name}: frozen when {' or '.join(ends)}"
    if not role.begins_anew:
        return told
    whence = "its first policy" if role.reset == "initial" else "the newest main player"
    chance = "" if role.reset_chance in (None, 1) else f", with probability {role.reset_chance:g}"
    return f"{told}; then it begins anew from {whence}{chance}"


def _schedule(opened: Open) -> Schedule:
    schedules = {kind: Schedule(kind) for kind in get_args(Kind)}
    return schedules.get(opened.setting("training", "schedule", "kind", otherwise=""), Schedule())


def _progress(opened: Open, standing: Standing) -> dict[str, float]:
    """The part of their budget that groups have had, of time or of steps, whichever ends first."""
    budget = Budget(
        opened.setting("budget", "train", otherwise="") or None, opened.setting("budget", "steps", otherwise=0) or None
    )
    found = {}
    for group in standing.groups:
        seconds, steps = standing.spent(group, _schedule(opened))
        parts = [seconds / budget.train_seconds, *([steps / budget.steps] if budget.steps else [])]
        found[f"group {group}"] = min(1.0, max(parts))
    return found if budget.train or budget.steps else {}


def _lit(opened: Open, players: Sequence[dict]) -> list[dict]:
    """Players in their colours, with the score in training over their newest iterations, from 0 to 1."""
    colours, found = styles(row["player"] for row in players), []
    for row in players:
        points = opened.store.curves(opened.league, row["player"], after=row["iteration"] - RECENT)
        scores = [point.values["score"] for point in points if "score" in point.values]
        found.append({**row, SCORE.key: spark(scores, 0.0, 1.0), "style": colours[row["player"]]})
    return found


def _share(opened: Open, players: Sequence[Player], checkpoints: Mapping[str, Checkpoint]) -> str:
    """What rating matches have taken of the devices that train, since the first of which that is known."""
    rated, first = opened.store.booked(opened.league)
    asked = opened.setting("rating", "share", otherwise=Rating().share)
    since = Standing(players, checkpoints=checkpoints).trained(_schedule(opened)) - first
    return words(asked, max(0.0, since), rated)


def _failed(job: Job, whole: bool) -> str:
    return f"{job.key}, tried {job.failures} times: {_error(job.error, whole)}"


def _error(error: str | None, whole: bool) -> str:
    """The first line of a reason, and how to see the others; or all lines."""
    lines = (error or "no reason was given").strip().splitlines()
    if whole or len(lines) == 1:
        return "\n    ".join(lines)
    return f"{lines[0]} (--debug shows it all)"


def _listed(title: str, lines: Sequence[str]) -> list[str]:
    return ["\n".join([f"{title}:", *(f"  {line}" for line in lines)])] if lines else []


def _worker(worker: Worker, leased: Mapping[str | None, Job], now: float) -> dict:
    said, job = worker.status, leased.get(worker.id)
    return {
        "job": "" if job is None else str(job.id) if job.attempt == 1 else f"{job.id}, attempt {job.attempt}",
        "lease s": None if job is None or job.lease_until is None else job.lease_until - now,
        "worker": worker.id, "doing": said.get("doing", ""), "learners": "+".join(said.get("learners", [])),
        "iteration": said.get("iteration"), "steps/s": said.get("steps_per_second"),
        "seen s ago": round(now - worker.seen, 1),
    }  # fmt: skip


def _machine(store: Store) -> str:
    """How much room there is for the store, as far as it is of this machine, and in the memory of its GPUs."""
    folders = [Path(store.where).parent, getattr(store.blobs, "folder", None)]
    free = [shutil.disk_usage(folder).free for folder in folders if folder is not None and folder.is_dir()]
    told = [f"Disk: {min(free) / 1e9:,.1f} GB free"] if free and "://" not in store.where else []
    memory = [f"{gpu.used:.1f} of {gpu.total:.1f} GB of GPU {gpu.name} in use" for gpu in devices.memory()]
    return "; ".join([*told, *memory]) or "Disk: not of this machine"
