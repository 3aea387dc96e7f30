"""A league as a page: its sections with figures and tables, for `league report` and `league dash`.

The page has the same data as the commands `ratings`, `payoff`, `explain`, `curves`, `status`, `matches` and
`snapshots`, and is computed from the store alone.
"""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any
from urllib.parse import quote

from dashboards.tables import Column, render
from dashboards.web import figures
from dashboards.web.document import FigureBlock, FilmBlock, Page, PairTable, Part, Section, TableBlock
from league.config.schema import ConfigError
from league.queries.columns import CURVES, NEWEST, PLAYERS, WORKERS
from league.queries.league_status import LeagueStatus, gather_status
from league.queries.opponents import explain_opponents, mark_present, opponent_columns, team_named
from league.queries.page.learning_curves import SPEED, LearningCurves
from league.queries.page.match_tables import newest_matches, pair_table, played
from league.queries.page.overview import Facts, overview
from league.queries.query import Open, Shown, snapshot_rows
from league.queries.ratings.ladder_tables import ISLAND, LADDER, TRIED, for_people, notes_on, title_of
from league.queries.ratings.metagame import table as payoff_table
from league.queries.ratings.rating_rows import VOID_NOTE, Row, rating_rows, side_text, unlike_sides, when
from league.queries.ratings.shown_players import SHOWN, of_table
from league.queries.ratings.unbounded_fits import several_ranked
from league.state.league_state import LeagueState
from league.state.liveness import leader, processes
from storage.errors import StorageError
from storage.records import Player

NO_FILMS = (FilmBlock("No film is made here: `league dash` and `league report` make some."),)
STEPS = Column("steps")
LINEAGE = (
    Column("name", "snapshot", no_wrap=True), Column("parent", "goes on from", no_wrap=True), "player", "origin",
    "iteration", "steps", Column("digest", no_wrap=True),
)  # fmt: skip
LISTED = 500
"""Maximum number of rows of a table of snapshots: nobody reads ten thousand, and a command has all."""
SHORT = 12  # hexadecimal digits of a digest that tell snapshots apart


def version(opened: Open) -> str:
    """Return a text that changes whenever the page does: with the store, the league's manager and its workers.

    It has only ASCII characters, because it is sent as a header of HTTP.
    """
    doing = sorted(f"{w.id} {w.status.get('doing', '')}" for w in processes(opened.store, opened.league))
    digest = hashlib.sha256("\n".join([leader(opened.store, opened.league) or "", *doing]).encode()).hexdigest()
    return f"{quote(opened.league, safe='')}:{opened.store.revision(opened.league)}:{digest[:SHORT]}"


def page(
    opened: Open, link_prefix: str = "", films: Sequence[FilmBlock] = NO_FILMS, state: LeagueState | None = None
) -> Page:
    """Return the current page of a league; matches link to their server's pages, at `link_prefix` and their number.

    The first of the `films` is shown in the overview, the others beside the matches. `state` saves reading if the
    caller has the league's state already.
    """
    now = version(opened)  # first, so that a change during the reading leads to another reading
    found = sections(opened, link_prefix, films, state)
    return Page(f"League {opened.league}", f"Robot League, {opened.store.where}", found, now)


def sections(
    opened: Open, link_prefix: str = "", films: Sequence[FilmBlock] = NO_FILMS, state: LeagueState | None = None
) -> list[Section]:
    """Return all sections about a league, in the order of the page."""
    state = state or LeagueState.of(opened.store, opened.league)
    shown = Shown(state.arena, [state.ladder], [], list(state.snapshots), list(state.players), opened.void_limit())
    status = gather_status(opened, True, state)
    curves = LearningCurves.of(opened)
    steps = {s.name: s.step for s in shown.snapshots if s.player}
    rows = [
        {**row, "steps": steps.get(row["name"])}
        for row in rating_rows(shown.ladders[0], shown.snapshots, shown.players, shown.void_limit)
    ]
    total = opened.store.last_match(opened.league)
    newest = played(opened.store.log(opened.league, after=total - NEWEST), link_prefix)
    first = overview(Facts(opened, shown, state, status, rows, curves), films[0])
    found: dict[tuple[str, str, str], Iterable[Part]] = {
        ("now", "Who learns now", "Players"): _schedule(status, opened.store.now()),
        ("ladder", "Ladder", ""): _ladder(rows, shown),
        ("ratings", "Ratings over training", "Ratings"): _ratings(rows, shown),
        ("payoff", "Payoff", ""): _payoff(shown, opened, link_prefix),
        ("opponents", "Opponents now", "Opponents"): _opponents(opened, state),
        ("curves", "Learning curves", "Curves"): _curves(curves, shown.names),
        ("throughput", "Throughput", ""): _throughput(curves, status, shown.names),
        ("jobs", "Jobs and errors", "Jobs"): _jobs(state, status),
        ("matches", "Newest matches", "Matches"): [*newest_matches(newest, total, link_prefix), *films[1:]],
        ("lineage", "Lineage", ""): _lineage(shown),
    }
    return [first, *(Section(id, title, list(parts), tab=tab) for (id, title, tab), parts in found.items())]


def _table(rows: Sequence[Mapping[str, Any]], columns: Sequence[Column | str], name: str) -> TableBlock:
    return TableBlock(render(rows, columns, "html", name), name)


def _schedule(status: LeagueStatus, now: float) -> Iterator[str | TableBlock]:
    runs = f"League {status.league}: {status.runs or 'stopped'}, as of {when(now)}"
    yield "\n".join([runs, *status.stages, *status.phases, *status.generations, *status.voids])
    yield _table(status.players, PLAYERS, "Players")


def _sides(rows: Sequence[Row], shown: Shown) -> Iterator[tuple[str, list[Row]]]:
    """Yield the name and the rows of each side; if all sides are alike, all rows under an empty name."""
    unlike = unlike_sides(shown.players)
    for roster in unlike:
        yield f" of {side_text(roster)}", [row for row in rows if row["roster"] == roster]
    if not unlike:
        yield "", list(rows)


def _ladder(rows: Sequence[Row], shown: Shown) -> Iterator[str | FigureBlock | TableBlock]:
    ladder = shown.ladders[0]
    yield "\n".join([f"{title_of(ladder)}.".replace("..", "."), *notes_on(ladder, rows, shown)])
    for name, own in _sides(rows, shown):
        known, merit = _known(own, shown)
        if known:
            which = f"the {figures.BARS} best of {len(known):,}" if len(known) > figures.BARS else f"all {len(known)}"
            caption = (
                f"{merit.capitalize()} with 95 % intervals{name}: {which} that are known. {_extremes(known, merit)}"
            )
            yield FigureBlock(figures.ladder(known, merit, shown.names), caption)
        columns = [*(TRIED if ladder.one_team else LADDER), STEPS]
        if several_ranked(own):
            columns.insert(1, ISLAND)
        title = f"Ladder{name}, best first"
        if len(own) > LISTED:
            title += f": the first {LISTED} of {len(own):,}; `league ratings` prints all"
        yield _table(for_people(own[:LISTED]), columns, title)


def _known(rows: Sequence[Row], shown: Shown) -> tuple[list[Row], str]:
    """Return the rows with a known rating, and the column that rates them."""
    merit = "success" if shown.ladders[0].one_team else "elo"
    return [row for row in rows if row[merit] is not None and (row["known"] or merit == "success")], merit


def _extremes(known: Sequence[Row], merit: str) -> str:
    digits = 0 if merit == "elo" else 3

    def ranked(row: Row) -> str:
        at, low, high = (f"{row[key]:.{digits}f}" for key in (merit, *figures.bounds(merit)))
        return f"{row['name']} at {at} ({low} to {high})"

    return f"Ranked first {ranked(known[0])}, last {ranked(known[-1])}."


def _ratings(rows: Sequence[Row], shown: Shown) -> Iterator[str | FigureBlock]:
    for name, own in _sides(rows, shown):
        known, merit = _known(own, shown)
        learnt = sorted((row for row in known if row["steps"] is not None), key=lambda row: row["steps"])
        if not learnt:
            yield f"No snapshot{name} has a known rating yet."
            continue
        newest = {row["player"]: row for row in learnt}
        caption = ", ".join(f"{row['name']} {row[merit]:.4g} at {row['steps']:,}" for _, row in sorted(newest.items()))
        yield FigureBlock(
            figures.ratings(known, merit, shown.names),
            f"{merit.capitalize()}{name} over the training steps of each player, with 95 % bands; level lines: what"
            f" does not learn. Newest known: {caption}. The ladder's table has the figures.",
        )


def _payoff(shown: Shown, opened: Open, link_prefix: str) -> Iterator[str | FigureBlock | TableBlock | PairTable]:
    if shown.ladders[0].one_team:
        yield "There is one team: nobody meets anybody."
        return
    try:
        found = payoff_table(shown.ladders[0], shown.snapshots, shown.players)
    except StorageError as error:
        yield str(error)
        return
    down, across = of_table(found, shown.ladders[0], shown.snapshots, figures.CELLS)
    rows, columns = [found.rows[i] for i in down], [found.columns[j] for j in across]
    scores, games = found.scores[down][:, across], found.games[down][:, across]
    caption = "Score of the rows against the columns, a draw counted half; blank where two have not met."
    caption += f" {VOID_NOTE}" if found.suspect else ""
    if (len(rows), len(columns)) != found.asked:
        caption += (
            f" {len(rows)} × {len(columns)} of {found.asked[0]:,} × {found.asked[1]:,} snapshots: {SHOWN}."
            " `league payoff --format csv` has all."
        )
    yield FigureBlock(figures.payoff(rows, columns, scores, games), f"{caption} A click on a cell shows its matches.")
    among = list(dict.fromkeys([*rows, *columns]))
    log = (opened.store.matches(opened.league, among=among), opened.store.ranked_matches(opened.league, among=among))
    met = sorted((*log[0], *log[1]), key=lambda match: match.id)
    yield pair_table(rows, columns, played(met, link_prefix), link_prefix)
    cells = [
        {"score %": name, **{other: found.cell(name, other, x) for other, x in zip(columns, line, strict=True)}}
        for name, line in zip(rows, scores.tolist(), strict=True)
    ]
    heads = [Column("score %", no_wrap=True), *(Column(name, decimals=0) for name in columns)]
    yield _table(cells, heads, "Score of the row against the column, in per cent")


def _opponents(opened: Open, state: LeagueState) -> Iterator[str | FigureBlock | TableBlock]:
    try:
        role_of, seed = opened.roles(), opened.setting("seed", otherwise=1)
    except ConfigError as error:
        yield f"This version cannot read the league's settings: {error}."
        return
    alone = True
    for player in state.players:
        for part in _mixture(explain_opponents(role_of(player.role), state, player, seed, NEWEST), player):
            alone = False
            yield part
    if alone:
        yield "Nobody meets anybody in training: there is one team, or nobody learns now."


def _mixture(found: Mapping[str, Any], player: Player) -> Iterator[FigureBlock | TableBlock]:
    for team in found["teams"] if found["learns"] else ():
        against = f" in {team_named(team)}" if len(found["teams"]) > 1 else ""
        caption = f"Whom {player.name} meets{against} by the rule {found['kind']}"
        yield FigureBlock(figures.mixture([*team["opponents"], *team["older"]]), f"{caption}: {team['why']}.")
        shown, total = mark_present(team["opponents"]), len(team["opponents"]) + len(team["older"])
        named = caption if len(shown) == total else f"{caption}: the newest {len(shown)} of {total:,}"
        yield _table(shown, opponent_columns(team), named)


def _curves(curves: LearningCurves, names: Sequence[str]) -> Iterator[str | FigureBlock | TableBlock]:
    if not curves.newest:
        yield "Nobody has learnt yet."
        return
    known = {"player", "iteration", "steps", "seconds", *curves.metrics}
    for key, title in curves.drawn.items():
        if key in known:
            caption = f"{title.capitalize()} over the training steps of each player."
            yield FigureBlock(figures.curves(curves.lines(key), title, players=names), caption + _means(curves.longest))
    columns = [c for c in CURVES if (c if isinstance(c, str) else c.key) in known]
    yield _table(curves.newest, columns, f"The newest {len(curves.newest)} of {curves.total:,} iterations")


def _means(most: int) -> str:
    """Describe a point of a curve of so many iterations."""
    return f" A point is a mean over up to {-(-most // figures.POINTS)} iterations." if most > figures.POINTS else ""


def _throughput(
    curves: LearningCurves, status: LeagueStatus, names: Sequence[str]
) -> Iterator[str | FigureBlock | TableBlock]:
    yield status.share
    if timed := curves.lines(SPEED, "seconds"):
        caption = ", ".join(f"{player} {rates[-1]:,.0f}" for player, (_, rates) in sorted(timed.items()))
        picture = figures.curves(timed, "steps per second", "seconds of training", names)
        means = _means(max(len(rates) for _, rates in timed.values()))
        yield FigureBlock(picture, f"Environment steps per second, learning included. Newest: {caption}.{means}")
    yield _table(status.workers, WORKERS[:-1], "Workers")  # the time at which they were last seen is soon out of date


def _jobs(state: LeagueState, status: LeagueStatus) -> Iterator[str | TableBlock]:
    yield f"Jobs: {status.jobs}"
    if status.paused:
        yield "\n".join(["Paused:", *status.paused])
    if status.failed:
        yield "\n".join(["Set aside:", *status.failed])
    rows = [
        {"job": job.id, "kind": job.kind, "state": job.state, "failures": job.failures, "holder": job.holder,
         "last error": (job.error or "").strip().splitlines()[0] if (job.error or "").strip() else None}
        for job in state.jobs[-NEWEST:]
    ]  # fmt: skip
    columns = ("job", "kind", "state", "failures", "holder", "last error")
    yield _table(rows, columns, "Jobs that wait, are worked on or were set aside")


def _lineage(shown: Shown) -> Iterator[FigureBlock | TableBlock | str]:
    rows = [{**row, "digest": row["digest"][:SHORT]} for row in snapshot_rows(shown.snapshots)]
    if not rows:
        yield "There is no snapshot yet."
        return
    children = sum(row["parent"] is not None for row in rows)
    caption = f"{len(rows):,} snapshots by their training steps, {children:,} of which continue from another one."
    yield FigureBlock(figures.lineage(rows, shown.names), caption)
    title = "Snapshots"
    if len(rows) > LISTED:
        title += f": the newest {LISTED} of {len(rows):,}; `league snapshots` prints all"
    yield _table(rows[-LISTED:], LINEAGE, title)
