"""Training of an attacker against one frozen policy, for `league exploit` and the bench."""

from collections.abc import Callable
from dataclasses import replace

from league.config.experiment import Config
from league.config.run_spec import RunSpec
from league.matches.exploitability import Attack, begin
from league.queries.query import Open
from league.runtime.manager import Manager, ManagerError
from league.runtime.preflight import preparation
from league.scheduling.training_progress import trained_enough
from league.state.league_state import LeagueState
from storage.records import Snapshot

Progress = Callable[..., None]


def train_attacker(
    opened: Open, where: str, chosen: Attack, progress: Callable[[Config], Progress] | None = None
) -> Snapshot | None:
    """Train the attacker until its budget is used; return its newest snapshot, None if it was stopped before.

    `where` is the store, as other processes open it; `progress` makes what the manager calls now and then. Raises
    ManagerError if the attacker cannot learn.
    """
    store, config = opened.store, chosen.config
    spec = RunSpec.of(where, config)
    with preparation(spec, config, imported=(chosen.victim.name,)) as (prepared, worker):
        begin(store, chosen)
        store.set_config(config.league, spec.config_toml)
        if not trained_enough(config, LeagueState.of(store, config.league)):
            sized = replace(spec, worlds=prepared.worlds)
            tell = (lambda *_: None) if progress is None else progress(config)
            if Manager(store, sized, config, worker).run(tell) == "stopped":
                return None
    frozen = store.snapshots(config.league, chosen.player)
    if not frozen or not frozen[-1].iteration:
        raise ManagerError(f"the attacker has learnt nothing: `league status --league {config.league}` tells why")
    return frozen[-1]
