"""A ladder as tables for people, with notes on the meaning of its figures."""

from collections.abc import Sequence
from itertools import combinations, product

from dashboards.tables import Column
from dashboards.text import clock
from league.queries.query import Shown, score_text
from league.queries.ratings import unbounded_fits
from league.queries.ratings.rating_rows import (
    FEW,
    VOID_MARK,
    VOID_NOTE,
    Row,
    side_score,
    side_text,
    unlike_sides,
)
from matchmaking.ratings.fit import Ratings
from matchmaking.ratings.ladder import ANCHOR_ELO, UNKNOWN, Ladder
from matchmaking.ratings.scores import quantile
from storage.records import ArenaKey, Snapshot

RANKED = (
    "Ranks go by the lower end of the interval (elo less ±), so few games do not put anybody ahead. met: how many"
    f" others it has met; *: provisional, fewer than {FEW}. ± covers chance alone, not that one opponent may suit a"
    " policy better than another of equal strength."
)
RANKED_ALONE = "Ranks go by the lower end of the interval, so few games do not put anybody ahead."

ISLAND = Column("island")  # if there are several
ABOUT = (
    Column("trained", no_wrap=True), Column("role", no_wrap=True), Column("player", no_wrap=True),
    Column("last", "last played", no_wrap=True),
)  # fmt: skip
LADDER = (
    Column("rank", "", 0), Column("name", "snapshot", no_wrap=True), Column("elo", decimals=0), Column("error", "±", 0),
    "games", Column("met", no_wrap=True), Column("win_rate", "win rate", 3), Column("vs_initial", "vs initial", 3),
    Column("void", "void %", no_wrap=True), Column("result", "w-d-l", no_wrap=True), *ABOUT,
)  # fmt: skip
TRIED = (
    Column("rank", "", 0), Column("name", "snapshot", no_wrap=True), Column("success", decimals=3),
    Column("success_low", "from", 3), Column("success_high", "to", 3), "games", Column("void", "void %", no_wrap=True),
    *ABOUT,
)  # fmt: skip


MARKED = {"win_rate": "suspect", "success": "suspect", "vs_initial": "vs_initial_suspect"}
"""Scores that are marked if void episodes make them suspect, each with the column of the row that decides it."""


def for_people(rows: Sequence[Row]) -> list[Row]:
    """Return a ladder's rows with the columns that tables for people have beside those for programs."""
    return [
        {
            **row,
            "error": (row["high"] - row["low"]) / 2 if row["known"] else None,
            "elo": row["elo"] if row["known"] else None,
            "met": f"{row['opponents']}{'*' if row['provisional'] else ''}" if row["opponents"] else None,
            "trained": None if row["seconds"] is None else clock(row["seconds"]),
            "void": _void(row),
            **{key: _marked(row[key], row[of]) for key, of in MARKED.items()},
            "result": f"{row['wins']}-{row['draws']}-{row['losses']}" if row["games"] else None,
            "last": row["last_played"] and row["last_played"][:16].replace("T", " "),
        }
        for row in rows
    ]


def notes_on(ladder: Ladder, rows: Sequence[Row], shown: Shown, ranked: bool = True) -> list[str]:
    """Return lines on the meaning of a ladder's figures, the column that ranks, and scores between unlike sides."""
    sides = unlike_sides(shown.players)
    order = [RANKED_ALONE if ladder.one_team else RANKED] if ranked and ladder.arena is not None else []
    notes = _notes(ladder, rows, shown.void_limit, bool(sides))
    return [*notes, *order, *_between(ladder, shown.snapshots, sides)]


def title_of(ladder: Ladder) -> str:
    """Return the title of a ladder's table."""
    if ladder.arena is None:
        return "No rating match has been played yet."
    what = "Success" if ladder.one_team else "Elo"
    return f"{what} with 95 % intervals in {called(ladder.arena)}"


def called(key: ArenaKey) -> str:
    """Return a ladder's arena, engine and rules in a few words."""
    return f"{key.arena} under {key.engine} (rules {key.config_hash[:8]})"


def _notes(ladder: Ladder, rows: Sequence[Row], void_limit: float, by_side: bool) -> list[str]:
    """Explain the figures that occur in the table, with one or two sentences for each."""
    notes = []
    if ladder.arena is not None and not ladder.one_team:
        of = "each side's" if by_side else "the"
        notes.append(f"The mean of {of} initial snapshots is {ANCHOR_ELO:.0f} Elo.")
        if not all(row["known"] for row in rows):
            notes[0] += f" –: not yet known (an interval wider than {UNKNOWN:.0f} Elo, or no game)."
        if ladder.payoff.rankings:
            notes.append("Ratings are fitted to whole rankings; in games and w-d-l each other team counts as a game.")
        notes += unbounded_fits.of_ladder(ladder)
        if abs(ladder.ratings.side_advantage) >= 0.5 and not ladder.separation.side:
            notes.append(_first_side(ladder.ratings))
    if any(row["voids_own"] or row["voids_unclear"] for row in rows):
        text = "void %: episodes that unstable physics stopped, by the snapshot's own robots + of unclear cause."
        if any(row["flagged"] for row in rows):
            text += f" !: above {100 * void_limit:g} % by its own robots; ?: above it if the unclear ones are its own."
        notes.append(text)
    if any(row["suspect"] or row["vs_initial_suspect"] for row in rows):
        notes.append(VOID_NOTE)
    return notes


def _first_side(ratings: Ratings) -> str:
    """Return a line on the worth of the first side, with its 95 % interval."""
    side, around = ratings.side_advantage, ratings.quantile * ratings.side_stderr
    worth = f"Playing the first side is worth {side:+.0f} Elo (± {around:.0f})"
    if abs(side) <= around:
        return f"{worth}, so perhaps nothing."
    return f"{worth}: against an equal it scores {100 * ratings.first_side_score():.1f} %, not 50."


def _between(ladder: Ladder, frozen: Sequence[Snapshot], sides: Sequence[str]) -> list[str]:
    """Return the scores of unlike sides against each other: of all snapshots, and of the newest of each."""
    notes = []
    for one, other in combinations(sides, 2):
        score = side_score(ladder, frozen, one, other)
        if not score.games:
            continue
        text = f"{side_text(one)} against {side_text(other)}: {score_text(score)} in all."
        known = sorted((s for s in frozen if s.player and ladder.known(s.name)), key=lambda s: s.iteration)
        newest = [[s.name for s in known if s.roster == roster][-1:] for roster in (one, other)]
        for a, b in product(*newest):
            text += f" By these ratings {a} scores {100 * ladder.ratings.expected(a, b):.1f} % against {b}."
        notes.append(text)
        if not {one, other} <= set(ladder.ratings.populations):
            continue
        population_offset, error = ladder.ratings.population_offset(one, other)
        notes.append(
            f"Between what stands at {ANCHOR_ELO:.0f} on either side the arena leans to"
            f" {side_text(one if population_offset >= 0 else other)} by {abs(population_offset):.0f} Elo"
            f" (± {quantile(0.95) * error:.0f})."
        )
    if notes:
        notes.append("Elo tells skill within a side; between sides the tilt comes on top, role and skill in one.")
    return notes


def _marked(score: float | None, suspect: bool | None) -> float | str | None:
    """Return a score, with a mark if it is suspect."""
    return f"{score:.3f}{VOID_MARK}" if suspect and score is not None else score


def _void(row: Row) -> str | None:
    own, unclear = 100 * row["voids_own"], 100 * row["voids_unclear"]
    if not row["games"] and not own + unclear:
        return None
    return (f"{own:.1f}" + (f" + {unclear:.1f}" if unclear else "") if own or unclear else "0") + row["flagged"]
