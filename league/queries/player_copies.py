"""Population based training in words: the hyperparameters of players, their last copies and their next comparisons."""

from league.queries.league_settings import LeagueSettings
from league.scheduling import population
from league.state.league_state import LeagueState
from storage.blobs import arrays
from storage.store import Store


def describe_copies(store: Store, settings: LeagueSettings, state: LeagueState) -> dict[str, str]:
    """Describe each player's hyperparameters that may move, its last copy and its next comparison, by player.

    The hyperparameters are those of its checkpoint. Empty without copies.
    """
    ready, found = settings.copies_after, {}
    names = settings.get("training", "pbt", "hyperparameters", otherwise=[])
    for player in (p.name for p in state.players if ready):
        at = state.checkpoints.get(player)
        if at is None or not state.history(player):
            continue
        moved = population.read(arrays.from_bytes(store.blobs.get(at.digest)), names)
        values = [f"{name} {value:.3g}" for name, value in moved.items()] or ["no hyperparameter moves"]
        begun = population.since(state, player)
        copied = "has copied nobody yet" if begun.initial else f"goes on from {begun.parent} since {begun.name}"
        left = max(0, begun.step + ready - at.step)
        when = f"is compared after {left:,} steps more" if left else "is ready to be compared"
        found[player] = f"{', '.join(values)}; {copied}, {when}"
    return found
