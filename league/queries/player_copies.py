"""Population based training in words: the hyperparameters of players, their last copies and their next comparisons."""

from collections.abc import Mapping

from league.queries.league_settings import LeagueSettings
from league.scheduling import population
from league.state.league_state import LeagueState
from storage.blobs import arrays
from storage.store import Store


def read_hyperparameters(store: Store, settings: LeagueSettings, state: LeagueState) -> dict[str, dict[str, float]]:
    """Return, by player, the hyperparameters that may move, as its checkpoint has them; empty without copies."""
    names = settings.get("training", "pbt", "hyperparameters", otherwise=[])
    compared = [p.name for p in state.players if p.name in state.checkpoints and settings.copies_after]
    return {
        player: population.read(arrays.from_bytes(store.blobs.get(state.checkpoints[player].digest)), names)
        for player in compared
        if state.history(player)
    }


def copying(ready: int, state: LeagueState, player: str, hyperparameters: Mapping[str, float]) -> str:
    """Describe a player's hyperparameters, its last copy, and its next comparison after `ready` steps."""
    values = [f"{name} {value:.3g}" for name, value in hyperparameters.items()] or ["no hyperparameter moves"]
    begun = population.since(state, player)
    copied = "has copied nobody yet" if begun.initial else f"goes on from {begun.parent} since {begun.name}"
    left = max(0, begun.step + ready - state.checkpoints[player].step)
    when = f"is compared after {left:,} steps more" if left else "is ready to be compared"
    return f"{', '.join(values)}; {copied}, {when}"
