"""The status of a league for `league status` and the page: rows and lines, read from its store and this machine."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dashboards.text import clock
from league.config.sections import Budget
from league.queries.league_settings import LeagueSettings
from league.queries.player_copies import describe_copies
from league.queries.query import Open, score_text
from league.scheduling.player_resets import Generation, current_generation
from league.state.curriculum_stage import course
from league.state.league_state import Group, LeagueState, read_games
from league.state.liveness import leader, processes
from league.state.training_games import TrainingGames
from league.state.void_rates import warnings as void_warnings
from league.system import devices
from matchmaking.roles import FIXED, Role
from matchmaking.schedule import LearningCounts, remaining
from storage.blobs.folder import FolderBlobs
from storage.records import Job, JobState, Phase, Player, Worker
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
        """The jobs, counted, in a line; those of a process that was killed are not being worked on."""
        words = dict(STATES)
        if not self.runs and not self.workers and self.counts["leased"]:
            words["leased"] = "left by a process that is gone, done again by the next 'league run'"
        return ", ".join(f"{n:,} {words[state]}" for state, n in self.counts.items())


def gather_status(opened: Open, whole_errors: bool = False, state: LeagueState | None = None) -> LeagueStatus:
    """Return a league's status, with the first line of each error, or all of it.

    `state` saves reading if the caller has the league's state already, with games.
    """
    store, league, settings = opened.store, opened.league, opened.settings()
    state = state or _read_state(store, league, settings)
    manager, alive = leader(store, league), processes(store, league)
    workers = [worker for worker in alive if worker.kinds != "manager"]
    runs, counts = _runs(manager, len(workers)), store.job_counts(league)
    groups = state.learning_groups(settings.schedule())
    failed = [job for job in state.jobs if job.failures]
    population = [f"{name}: {text}" for name, text in describe_copies(store, settings, state).items()]
    generations = _generations(_roles(settings, state), state)
    return LeagueStatus(
        league, runs, {name: counts.get(name, 0) for name in STATES},
        [_player(player, state, bool(runs)) for player in state.players],
        _rating_share(store, league, settings.rating_share, sum(group.seconds for group in groups)),
        _stages(store, league),
        generations,
        [_phase(p, state) for p in state.phases.values() if p.learners],
        population,
        [f"{p.name}: {_error(p.paused, whole_errors)}" for p in state.players if p.paused is not None],
        [_failed_job(job, whole_errors) for job in failed if job.state != "failed"],
        [_failed_job(job, whole_errors) for job in failed if job.state == "failed"],
        void_warnings(state.voids),
        _workers(workers, state, store.now()),
        _progress(settings.training_budget(), groups),
        _machine(_free_disk(store), devices.memory()),
    )  # fmt: skip


def _read_state(store: Store, league: str, settings: LeagueSettings) -> LeagueState:
    """Return the state of a league, with snapshots and training games only if the status needs them."""
    state = LeagueState.without_games(store, league)
    if settings.copies_after or any(role.has_generations for role in _roles(settings, state).values()):
        games = read_games(store, league, TrainingGames())
        return replace(state, snapshots=store.snapshots(league, brief=True), meetings=games)
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
    finishing = (
        "1 worker still finishes what it does" if workers == 1 else f"{workers} workers still finish what they do"
    )
    return f"stopping, {finishing}" if workers else ""


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
    text = describe_rating_share(share, max(0.0, trained - start), rated, store.booked_episodes(league))
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
    """Return the least free bytes of the folders that hold the database and the blobs; None if neither is here."""
    kept = store.blobs.kept
    folders = [] if "://" in store.where else [Path(store.where).parent]
    folders += [kept.folder] if isinstance(kept, FolderBlobs) else []
    return min((shutil.disk_usage(folder).free for folder in folders if folder.is_dir()), default=None)


# Lines ----------------------------------------------------------------------------------------------------------------


def _phase(phase: Phase, state: LeagueState) -> str:
    """Name the learners of a turn, the iteration at which it began and the rule that ends it."""
    left = remaining(phase, {name: LearningCounts(at.iteration, at.step) for name, at in state.checkpoints.items()})
    since = ", ".join(dict.fromkeys(str(phase.since.get(name, 0)) for name in phase.learners))
    if left is None:
        end = "nothing ends it"
    elif "step" in phase.until:
        end = f"it ends at step {phase.until['step']:,}, {left:,} are left"
    else:
        end = f"it ends after {phase.until['iterations']} iterations, {left} are left"
    if "score" in phase.until:
        score = state.scores[phase.learners[0]]
        now = f"it scores {score_text(score)}" if score.games else "no episode has ended yet"
        sure = f"surely scores above {100 * phase.until['score']:g} %: {now}"
        over = score.low > phase.until["score"]
        end = f"its turn is over, because it {sure}" if over else f"{end}, or before that when it {sure}"
    verb = "learns" if len(phase.learners) == 1 else "learn"
    return f"group {phase.group}: {' and '.join(phase.learners)} {verb} since iteration {since}; {end}"


def _generation(player: Player, now: Generation) -> str:
    """Describe the start of a player's generation, the rule that ends it, and what follows."""
    role, ends = now.role, []
    if role.win_rate is not None:
        least = min(now.scores.items(), key=lambda item: item[1].low, default=None)
        text = "nobody is there yet" if least is None else f"least sure against {least[0]}, {score_text(least[1])}"
        ends.append(f"it surely scores above {100 * role.win_rate:g} % against all {len(now.scores)} it meets ({text})")
    if role.timeout is not None:
        ends.append(f"after {role.timeout:,} steps ({now.left:,} are left)")
    text = f"{player.name} ({role.name}) since {now.since.name}: frozen when {' or '.join(ends)}"
    if not role.can_reset:
        return text
    source = "its first policy" if role.reset == "initial" else "the newest main player"
    chance = "" if role.reset_chance in (None, 1) else f", with probability {role.reset_chance:g}"
    return f"{text}; then it is reset to {source}{chance}"


def _generations(roles: Mapping[str, Role], state: LeagueState) -> list[str]:
    """Describe the current generation of each player whose role has generations."""
    now = [
        (p, current_generation(roles[p.name], state, p, state.checkpoints[p.name].step))
        for p in state.players
        if p.name in roles
    ]
    return [_generation(player, each) for player, each in now if each is not None]


def _failed_job(job: Job, whole: bool) -> str:
    """Name a job with the number of attempts and the last error, whole or its first line."""
    return f"{job.key}, tried {job.failures} times: {_error(job.error, whole)}"


def _error(text: str | None, whole: bool) -> str:
    """Return all lines of an error, or the first line and a hint how to see the others."""
    lines = (text or "no reason was given").strip().splitlines()
    if whole or len(lines) == 1:
        return "\n    ".join(lines)
    return f"{lines[0]} (--debug shows it all)"


def describe_rating_share(share: float, trained: float, rated: float, episodes: int = 0) -> str:
    """Describe the requested share and the actual share of `rated` device seconds.

    With `episodes` played in these seconds, add the episodes per second of a device.
    """
    asked = "as much as they get" if share == 1.0 else f"{100 * share:.3g} %"
    if not trained:
        return f"nobody has learnt yet (rating.share: {asked})"
    speed = episodes / rated if rated else 0.0
    pace = f", {speed:{',.0f' if speed >= 100 else '.3g'}} games per second of a device" if speed else ""
    spent = 100 * rated / trained
    share_text = f"{spent:{',.0f' if spent >= 100 else '.3g'}} % of the time of the devices that train"
    return f"{share_text} (rating.share: {asked}){pace}"


def _machine(free_disk: float | None, gpus: Sequence[devices.Memory]) -> str:
    """Describe the free disk space for a store, and the memory of this machine's GPUs in use."""
    disk = [f"Disk: {free_disk / 1e9:,.1f} GB free"] if free_disk is not None else []
    memory = [f"{gpu.used:.1f} of {gpu.total:.1f} GB of GPU {gpu.name} in use" for gpu in gpus]
    return "; ".join([*disk, *memory]) or "Disk: no folder of the store is here"
