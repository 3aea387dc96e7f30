"""Facts about a league, read in front of a status: from its store, and from this machine."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

from league.config.sections import Budget
from league.queries.league_settings import LeagueSettings
from league.scheduling import population
from league.state.curriculum_stage import course
from league.state.league_state import Group, LeagueState
from league.state.liveness import leader, processes
from league.system import devices
from matchmaking.roles import Role
from storage.blobs import arrays
from storage.records import JobState, Worker
from storage.store import Store

if TYPE_CHECKING:  # loads the configuration
    from league.scheduling.curriculum import StageProgress


@dataclass(frozen=True)
class LeagueFacts:
    """Facts about a league that its status shows."""

    league: str
    budget: Budget  # of training
    rating_share: float  # of device time that the settings ask for
    copies_after: int  # environment steps after which players may copy each other; 0 if never
    state: LeagueState  # with snapshots and training games only if the status needs them
    groups: Sequence[Group]
    trained: float  # seconds of devices, by all groups
    manager: str | None
    workers: Sequence[Worker]  # that are alive, without the manager
    stages: Sequence["StageProgress"]  # of its curriculum
    roles: Mapping[str, Role]  # of the players that have been trained
    hyperparameters: Mapping[str, Mapping[str, float]]  # of the players that may copy each other
    job_counts: Mapping[JobState, int]
    now: float  # on the database's clock
    rating_seconds: float  # of devices, taken by rating matches of which this is known
    rating_start: float  # the second of training at which it was first recorded
    rating_episodes: int  # that were played in these seconds
    free_disk: float | None  # bytes for the store on this machine; None if it is elsewhere
    gpus: Sequence[devices.Memory]  # of this machine

    @classmethod
    def read(cls, store: Store, league: str, state: LeagueState | None = None) -> Self:
        """Read all facts; `state` saves reading if the caller has the league's state already, with games."""
        settings = LeagueSettings(league, store.league(league).config)
        role_of, schedule, budget, share = (
            settings.roles(), settings.schedule(), settings.training_budget(), settings.rating_share,
        )  # fmt: skip
        games, state = state is not None, state or LeagueState.without_games(store, league)
        manager, workers, stages = leader(store, league), processes(store, league), _stages(store, league)
        groups, trained = state.learning_groups(schedule), state.trained(schedule)
        roles = {p.name: role_of(p.role) for p in state.players if p.name in state.checkpoints}
        if not games and (settings.copies_after or any(role.has_generations for role in roles.values())):
            state = replace(state, snapshots=store.snapshots(league, brief=True), meetings=store.meetings(league))
        return cls(
            league, budget, share, settings.copies_after, state, groups, trained, manager,
            [worker for worker in workers if worker.kinds != "manager"], stages, roles,
            read_hyperparameters(store, settings, state), store.job_counts(league), store.now(),
            *store.booked(league), store.booked_episodes(league), _free_disk(store), devices.memory(),
        )  # fmt: skip

    @property
    def runs(self) -> str:
        """Describe the process that runs the league; return an empty text for a league that is stopped.

        A manager that was killed leads until its lease expires, unless its process is known to be gone.
        """
        if self.manager is not None:
            return f"running, managed by {self.manager}"
        return f"stopping, {len(self.workers)} workers still finish what they do" if self.workers else ""


def read_hyperparameters(store: Store, settings: LeagueSettings, state: LeagueState) -> dict[str, dict[str, float]]:
    """Return, by player, the hyperparameters that may move, as its checkpoint has them; empty without copies."""
    names = settings.get("training", "pbt", "hyperparameters", otherwise=[])
    compared = [p.name for p in state.players if p.name in state.checkpoints and settings.copies_after]
    return {
        player: population.read(arrays.from_bytes(store.blobs.get(state.checkpoints[player].digest)), names)
        for player in compared
        if state.history(player)
    }


def _stages(store: Store, league: str) -> Sequence["StageProgress"]:
    """Return the stages of the league's curriculum; settings are read only if it has one."""
    if course(store, league) is None:
        return ()
    from league.scheduling import curriculum

    return curriculum.read_stages(store, league)


def _free_disk(store: Store) -> float | None:
    folders = [Path(store.where).parent, getattr(store.blobs, "folder", None)]
    free = [shutil.disk_usage(folder).free for folder in folders if folder is not None and folder.is_dir()]
    return min(free) if free and "://" not in store.where else None
