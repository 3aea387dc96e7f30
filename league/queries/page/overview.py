"""First section of the page: who leads, whether training still gains, what is wrong, and the newest film."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from dashboards.text import clock
from dashboards.web import figures
from dashboards.web.document import Card, FigureBlock, FilmBlock, Section
from league.queries.league_status import LeagueStatus
from league.queries.page.learning_curves import LearningCurves
from league.queries.page.training_gain import ORDER, Gain, gains
from league.queries.page.troubles import troubles
from league.queries.query import Open, Shown, score_text
from league.queries.ratings.evidence import short_evidence
from league.queries.ratings.rating_rows import Row, side_text, unlike_sides
from league.state.league_state import LeagueState
from matchmaking.ratings.comparison import compare_snapshots

LINES = 5
"""Maximum number of lines of a card, so that the overview fits a screen: the sections have all."""
TREND = 210  # pixels


class Facts(NamedTuple):
    """Facts from which the overview is computed; the other sections have read them too."""

    opened: Open
    shown: Shown
    state: LeagueState
    status: LeagueStatus
    rows: Sequence[Row]  # of the ladder, best first
    curves: LearningCurves


def overview(facts: Facts, film: FilmBlock) -> Section:
    """Return the section: three cards, and beside them the film and the course of the ratings or of the scores."""
    cards = [_leads(facts), _learning(facts), _wrong(facts)]
    return Section("overview", "Overview", cards, [film, *_trend(facts)])


def _leads(facts: Facts) -> Card:
    shown, found = facts.shown, list(_leaders(facts))
    links = [("ladder", "Ladder"), ("payoff", "Payoff")]
    if not found:
        lines = ["No snapshot has a known rating."]
        if shown.ladders[0].arena is None:
            lines = ["No rating match has been played yet; `league rate` plays some without training."]
        return Card("Who leads", "Not known yet", lines, links[:1])
    known = {row["name"] for row in facts.rows if row["rank"] is not None}
    late = [s.name for s in facts.state.newest_snapshots if s.name not in known]
    waiting = [f"Not rated yet: {', '.join(late[:3])}{_others(len(late) - 3)}."] if late else []
    answers, lines = zip(*found, strict=True)
    return Card("Who leads", "; ".join(answers), _first([*lines, *waiting]), links)


def _leaders(facts: Facts) -> Iterator[tuple[str, str]]:
    """Yield the leader of each side and the evidence, or if all sides are alike, of all."""
    ladder, ranked = facts.shown.ladders[0], [row for row in facts.rows if row["rank"] is not None]
    for roster in unlike_sides(facts.shown.players) or [None]:
        own = [row for row in ranked if roster in (None, row["roster"])]
        if not own:
            continue
        first, where = own[0], f" of {side_text(roster)}" if roster else ""
        if ladder.one_team:
            yield (
                f"{first['name']}{where} leads",
                f"{first['name']} succeeds: {score_text(ladder.success(first['name']))}.",
            )
            continue
        rating = f"{first['name']}{where}: {first['elo']:.0f} Elo (95 %: {first['low']:.0f} to {first['high']:.0f})"
        rival = next((row for row in own[1:] if row["player"] is None or row["player"] != first["player"]), None)
        if rival is None:
            yield f"{first['name']} leads", f"{rating}."
            continue
        found = compare_snapshots(ladder, first["name"], rival["name"])
        if first["digest"] == rival["digest"]:
            yield f"{first['name']} and {rival['name']} lead", f"{rating}, the same policy as {rival['name']}."
        elif found.sure and found.first == first["name"]:
            yield f"{first['name']} leads", f"{rating}; stronger than {rival['name']}: it {short_evidence(found)}."
        else:
            ahead = f"{found.first} {short_evidence(found)}"
            yield (
                f"{first['name']} leads, not surely",
                f"{rating}; not known to be stronger than {rival['name']}: {ahead}.",
            )


def _learning(facts: Facts) -> Card:
    state, status = facts.state, facts.status
    links = [("ratings", "Ratings"), ("curves", "Curves"), ("now", "Players")]
    if state.newest is None:
        return Card("Is it still learning?", "Not begun", [f"The league is {_runs(status)}."], links)
    found = gains(facts.shown.ladders[0], state)
    used = [f"{100 * min(status.progress.values()):.0f} % of its training budget"] if status.progress else []
    groups = state.learning_groups(facts.opened.settings().schedule())
    seconds, steps = max(group.seconds for group in groups), max(group.steps for group in groups)
    so_far = [f"iteration {state.newest.iteration:,}", f"{steps:,} steps", f"{clock(seconds)} of training", *used]
    lines = [f"The league is {_runs(status)}: {', '.join(so_far)}.", *(gain.text for gain in found)]
    return Card("Is it still learning?", _verdict(found, bool(status.runs)), _first(lines), links)


def _first(lines: Sequence[str]) -> list[str]:
    """Return the lines that a card has room for, and the number of the others."""
    return list(lines) if len(lines) <= LINES else [*lines[: LINES - 1], f"{len(lines) - LINES + 1} more."]


def _runs(status: LeagueStatus) -> str:
    return status.runs.partition(",")[0] or "stopped"


def _verdict(found: Sequence[Gain], runs: bool) -> str:
    """Answer for all players at once: losses first, since a mean of gains and losses would hide them."""
    by: Mapping[str, list[str]] = {kind: [gain.player for gain in found if gain.kind == kind] for kind in ORDER}
    if by["worse"]:
        return f"{_named(by['worse'])}: worse than at half the training"
    if by["better"]:
        who = "Yes" if len(by["better"]) == len(found) else f"Yes: {_named(by['better'])}; others not surely"
        return who if runs else f"{who}, until it stopped"
    return "No sure gain over the last half" if by["open"] else "Not known yet"


def _named(players: Sequence[str]) -> str:
    return f"{', '.join(players[:3])}{_others(len(players) - 3)}"


def _others(count: int) -> str:
    return f" and {count} others" if count > 1 else " and one other" if count == 1 else ""


def _wrong(facts: Facts) -> Card:
    found = troubles(facts.opened, facts.state, facts.status, facts.rows)
    answer = f"{len(found)} thing{'s' * (len(found) != 1)}" if found else "Nothing known"
    return Card(
        "What is wrong?", answer, _first(found), [("jobs", "Jobs and errors"), ("throughput", "Workers")],
        is_trouble=bool(found),
    )  # fmt: skip


def _trend(facts: Facts) -> Iterator[FigureBlock]:
    """Yield the ratings of what learns over its training; before there are any, the scores or rewards in training."""
    merit = "success" if facts.shown.ladders[0].one_team else "elo"
    learnt = [row for row in facts.rows if row["rank"] is not None and row["steps"] is not None]
    if len(learnt) > 1:
        yield FigureBlock(
            figures.compact(figures.ratings(learnt, merit, facts.shown.names), TREND),
            f"{merit.capitalize()} over training steps, with 95 % bands.",
        )
        return
    for key, title in (("score", "score in training"), ("reward", "reward per step")):
        if key in facts.curves.metrics:
            drawn = figures.compact(figures.curves(facts.curves.lines(key), title, players=facts.shown.names), TREND)
            yield FigureBlock(drawn, f"{title.capitalize()} over training steps; ratings come later.")
            return
