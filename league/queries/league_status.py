"""The status of a league for `league status` and the page: rows and lines, derived from its facts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dashboards.text import clock
from league.config.sections import Budget
from league.queries import status_lines
from league.queries.league_facts import LeagueFacts
from league.queries.query import Open
from league.scheduling import rating_budget
from league.state.league_state import Group, LeagueState
from league.state.void_rates import warnings as void_warnings
from matchmaking.roles import FIXED
from storage.records import Job, JobState, Player, Worker

STATES: Mapping[JobState, str] = {
    "queued": "queued",
    "leased": "being worked on",
    "done": "done",
    "failed": "set aside",
}


@dataclass(frozen=True)
class LeagueStatus:
    """Status of a league: rows of players and workers, and lines about everything else."""

    league: str
    runs: str  # description of the process that runs the league; empty for a league that is stopped
    counts: Mapping[JobState, int]  # jobs in each of STATES
    players: Sequence[dict]
    share: str  # of device time, taken by rating matches
    stages: Sequence[str]
    generations: Sequence[str]  # of players whose role has them
    phases: Sequence[str]
    population: Sequence[str]  # of players that may copy each other
    paused: Sequence[str]
    again: Sequence[str]  # jobs that failed and are tried again
    failed: Sequence[str]
    voids: Sequence[str]  # share of void episodes, cause and remedy; empty if few are void
    workers: Sequence[dict]
    progress: Mapping[str, float]  # of each group's training in its budget, from 0 to 1; empty without a budget
    machine: str  # free disk space and memory of GPUs

    @property
    def jobs(self) -> str:
        """The jobs, counted, in a line."""
        return ", ".join(f"{n:,} {STATES[state]}" for state, n in self.counts.items())


def gather_status(opened: Open, whole_errors: bool = False, state: LeagueState | None = None) -> LeagueStatus:
    """Return a league's status, with the first line of each error, or all of it.

    `state` saves reading if the caller has the league's state already.
    """
    return describe(LeagueFacts.read(opened.store, opened.league, state), whole_errors)


def describe(facts: LeagueFacts, whole_errors: bool = False) -> LeagueStatus:
    """Return the status of a league from its facts."""
    state = facts.state
    failed = [job for job in state.jobs if job.failures]
    return LeagueStatus(
        facts.league, facts.runs, {name: facts.job_counts.get(name, 0) for name in STATES},
        [_player(player, state, bool(facts.runs)) for player in state.players],
        f"Rating: {_rating_share(facts)}",
        status_lines.stages(facts.stages),
        status_lines.generations(facts.roles, state),
        [status_lines.phase_line(p, state) for p in state.phases.values() if p.learners],
        status_lines.population(facts.copies_after, state, facts.hyperparameters),
        [f"{p.name}: {status_lines.error(p.paused, whole_errors)}" for p in state.players if p.paused is not None],
        [status_lines.failed_job(job, whole_errors) for job in failed if job.state != "failed"],
        [status_lines.failed_job(job, whole_errors) for job in failed if job.state == "failed"],
        void_warnings(state.voids),
        _workers(facts),
        _progress(facts.budget, facts.groups),
        status_lines.machine(facts.free_disk, facts.gpus),
    )  # fmt: skip


def _player(player: Player, state: LeagueState, runs: bool) -> dict:
    at, phase = state.checkpoints.get(player.name), state.phases.get(player.group)
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


def _progress(budget: Budget, groups: Sequence[Group]) -> dict[str, float]:
    """Return the share of its budget that each group has used, of time or of steps, whichever ends first."""
    found = {}
    for group in groups if budget.training_time or budget.steps else ():
        parts = [group.seconds / budget.train_seconds, *([group.steps / budget.steps] if budget.steps else [])]
        found[f"group {group.name}"] = min(1.0, max(parts))
    return found


def _rating_share(facts: LeagueFacts) -> str:
    """Compare the device time of rating with that of training since the first rating batch whose time is known."""
    trained = max(0.0, facts.trained - facts.rating_start)
    return rating_budget.describe_share(facts.rating_share, trained, facts.rating_seconds, facts.rating_episodes)


def _workers(facts: LeagueFacts) -> list[dict]:
    leased = {job.holder: job for job in facts.state.jobs if job.state == "leased"}
    return [_worker(worker, leased.get(worker.id), facts.now) for worker in facts.workers]


def _worker(worker: Worker, job: Job | None, now: float) -> dict:
    said = worker.status
    return {
        "job": "" if job is None else str(job.id) if job.attempt == 1 else f"{job.id}, attempt {job.attempt}",
        "lease s": None if job is None or job.lease_until is None else job.lease_until - now,
        "worker": worker.id, "doing": said.get("doing", ""), "learners": "+".join(said.get("learners", [])),
        "iteration": said.get("iteration"), "steps/s": said.get("steps_per_second"),
        "seen s ago": round(now - worker.seen, 1),
    }  # fmt: skip
