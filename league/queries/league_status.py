"""The status of a league for `league status` and the page: rows and lines, read from its store and this machine."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dashboards.text import clock
from league.config.sections import Budget
from league.queries import status_lines
from league.queries.league_settings import LeagueSettings
from league.queries.player_copies import copying, read_hyperparameters
from league.queries.query import Open
from league.state.curriculum_stage import course
from league.state.league_state import Group, LeagueState
from league.state.liveness import leader, processes
from league.state.void_rates import warnings as void_warnings
from league.system import devices
from matchmaking.roles import FIXED, Role
from storage.records import Job, JobState, Player, Worker
from storage.store import Store

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

    `state` saves reading if the caller has the league's state already, with games.
    """
    store, league, settings = opened.store, opened.league, opened.settings()
    state = state or _read_state(store, league, settings)
    manager, alive = leader(store, league), processes(store, league)
    workers = [worker for worker in alive if worker.kinds != "manager"]
    runs, counts = _runs(manager, len(workers)), store.job_counts(league)
    groups, trained = state.learning_groups(settings.schedule()), state.trained(settings.schedule())
    moved = read_hyperparameters(store, settings, state)
    failed = [job for job in state.jobs if job.failures]
    return LeagueStatus(
        league, runs, {name: counts.get(name, 0) for name in STATES},
        [_player(player, state, bool(runs)) for player in state.players],
        _rating_share(store, league, settings.rating_share, trained),
        _stages(store, league),
        status_lines.generations(_roles(settings, state), state),
        [status_lines.phase_line(p, state) for p in state.phases.values() if p.learners],
        [f"{name}: {copying(settings.copies_after, state, name, own)}" for name, own in moved.items()],
        [f"{p.name}: {status_lines.error(p.paused, whole_errors)}" for p in state.players if p.paused is not None],
        [status_lines.failed_job(job, whole_errors) for job in failed if job.state != "failed"],
        [status_lines.failed_job(job, whole_errors) for job in failed if job.state == "failed"],
        void_warnings(state.voids),
        _workers(workers, state, store.now()),
        _progress(settings.training_budget(), groups),
        status_lines.machine(_free_disk(store), devices.memory()),
    )  # fmt: skip


def _read_state(store: Store, league: str, settings: LeagueSettings) -> LeagueState:
    """Return the state of a league, with snapshots and training games only if the status needs them."""
    state = LeagueState.without_games(store, league)
    if settings.copies_after or any(role.has_generations for role in _roles(settings, state).values()):
        return replace(state, snapshots=store.snapshots(league, brief=True), meetings=store.meetings(league))
    return state


def _roles(settings: LeagueSettings, state: LeagueState) -> dict[str, Role]:
    """Return the role of each player that has been trained."""
    role_of = settings.roles()
    return {p.name: role_of(p.role) for p in state.players if p.name in state.checkpoints}


def _runs(manager: str | None, workers: int) -> str:
    """Describe the process that runs a league with live workers; return an empty text for a league that is stopped.

    A manager that was killed leads until its lease expires, unless its process is known to be gone.
    """
    if manager is not None:
        return f"running, managed by {manager}"
    return f"stopping, {workers} workers still finish what they do" if workers else ""


def _stages(store: Store, league: str) -> list[str]:
    """Describe the stages of the league's curriculum; settings are read only if it has one."""
    if course(store, league) is None:
        return []
    from league.scheduling import curriculum

    return curriculum.report(curriculum.read_stages(store, league))


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


def _rating_share(store: Store, league: str, share: float, trained: float) -> str:
    """Compare the device time of rating with that of training since the first rating batch whose time is known."""
    rated, start = store.booked(league)
    text = status_lines.rating_share(share, max(0.0, trained - start), rated, store.booked_episodes(league))
    return f"Rating: {text}"


def _workers(workers: Sequence[Worker], state: LeagueState, now: float) -> list[dict]:
    leased = {job.holder: job for job in state.jobs if job.state == "leased"}
    return [_worker(worker, leased.get(worker.id), now) for worker in workers]


def _worker(worker: Worker, job: Job | None, now: float) -> dict:
    said = worker.status
    return {
        "job": "" if job is None else str(job.id) if job.attempt == 1 else f"{job.id}, attempt {job.attempt}",
        "lease s": None if job is None or job.lease_until is None else job.lease_until - now,
        "worker": worker.id, "doing": said.get("doing", ""), "learners": "+".join(said.get("learners", [])),
        "iteration": said.get("iteration"), "steps/s": said.get("steps_per_second"),
        "seen s ago": round(now - worker.seen, 1),
    }  # fmt: skip


def _free_disk(store: Store) -> float | None:
    """Return the free bytes for the store on this machine; None if the store is elsewhere."""
    folders = [Path(store.where).parent, getattr(store.blobs, "folder", None)]
    free = [shutil.disk_usage(folder).free for folder in folders if folder is not None and folder.is_dir()]
    return min(free) if free and "://" not in store.where else None
