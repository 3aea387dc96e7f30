"""A league opened from Python: its tables, opponents, payoffs, recordings and policies."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from league.queries import recordings
from league.queries.league_status import gather_status
from league.queries.match_players import players_of
from league.queries.opponents import explained
from league.queries.query import Open, match_frame
from league.queries.ratings.metagame import table
from league.runs.episode import Episode
from storage.errors import StorageError
from storage.recordings.recording import headers
from storage.records import Match, RankedMatch

if TYPE_CHECKING:
    import pandas as pd

    from league.snapshots.policy_callable import PolicyCallable


@dataclass(frozen=True)
class Payoff:
    """Scores of snapshots against snapshots: a row's score against a column, a draw counted half; nan if never met."""

    scores: "pd.DataFrame"
    games: "pd.DataFrame"


class OpenLeague(Open):
    """A league opened for reading.

    `ratings()`, `curves()`, `snapshots()`, `matches()`, `players()`, `explain(player)` and `recordings()` are data
    frames. `payoff()` is two of them, `recording()` an episode as arrays, `policy(name)` a callable. All are read anew
    at every call, so they follow a league that runs. Of a curriculum the newest stage is shown.
    """

    def __repr__(self) -> str:
        return f"<league {self.league} of {self.store.where}>"

    def players(self) -> "pd.DataFrame":
        """Return a row per player: team, role, group, iteration, steps, what it does now."""
        import pandas as pd

        return pd.DataFrame(gather_status(self).players)

    def payoff(
        self, rows: str | None = None, columns: str | None = None, newest: bool = False,
        arena: str | None = None, engine: str | None = None,
    ) -> Payoff:  # fmt: skip
        """Return the payoff table of a ladder, as `league payoff` does: names that match, or the newest snapshots.

        Raises StorageError if no rating match was played.
        """
        import pandas as pd

        shown = self.shown(arena, engine)
        found = table(shown.ladders[0], shown.snapshots, shown.players, rows, columns, newest)
        down, across = pd.Index(found.rows, name="row"), pd.Index(found.columns)
        return Payoff(pd.DataFrame(found.scores, down, across), pd.DataFrame(found.games, down, across))

    def explain(self, player: str) -> "pd.DataFrame":
        """Return a row per opponent that a player may meet in training now: probability, win rate, games, ...

        `attrs` of the frame has the rule, the share of past opponents, and why. Raises UnknownName.
        """
        import pandas as pd

        found = explained(self, player)
        rows = [{"team": team["team"], **row} for team in found["teams"] for row in team["opponents"]]
        frame = pd.DataFrame(rows)
        why = {team["team"]: team["why"] for team in found["teams"]}
        frame.attrs.update({key: value for key, value in found.items() if key != "teams"}, why=why)
        return frame

    def recordings(self) -> "pd.DataFrame":
        """Return the matches that were recorded, as rows of `matches()`; empty if there is none."""
        return match_frame(self.store.log(self.league, recorded=True))

    def recording(self, match: int | None = None, episode: int = 0, **wish: Any) -> Episode:
        """Return a recorded episode: of a match by its number, else of the newest match.

        `best=True`, `upset=True`, `player="blue"` and `between=("blue@8", "red@8")` choose as `league watch` does.
        Raises StorageError, one line, if there is none of that kind.
        """
        try:
            query = recordings.RecordingQuery(match, **wish)
        except TypeError:
            wishes = ", ".join(name for name in recordings.RecordingQuery.__annotations__ if name != "match")
            raise StorageError(f"a recording is chosen by match, episode, {wishes}; not {', '.join(wish)}") from None
        if query.clashing:
            raise StorageError(f"{' and '.join(query.clashing)} ask for different matches: give one of them")
        return self._episode(recordings.chosen(self, query), episode)

    def episodes(self, match: int) -> list[Episode]:
        """Return all recorded episodes of a match. Raises StorageError if it was not recorded."""
        chosen = recordings.chosen(self, recordings.RecordingQuery(match))
        count = len(headers(self.store.blobs.get(str(chosen.recording))))
        return [self._episode(chosen, number) for number in range(count)]

    def _episode(self, match: Match | RankedMatch, number: int) -> Episode:
        recording, _ = recordings.load(self, match, number)
        return Episode(match.id, recording, players_of(self, match, recording.header.sides))

    def policy(self, name: str, seed: int = 0) -> "PolicyCallable":
        """Return a snapshot, or a player's newest, as a callable from observations to actions.

        `seed` is for drawn actions. Raises UnknownName; StorageError for a thinned snapshot.
        """
        from league.snapshots.policy_callable import policy_callable

        return policy_callable(self, name, seed)
