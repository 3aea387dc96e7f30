"""A league as a page: its sections with figures and tables, for `league report` and `league dash`.

What it says is read as the commands that print it read it: `ratings`, `payoff`, `explain`, `curves`, `status`,
`matches`, `snapshots`. Reads the store and nothing else.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from dashboards import figures
from dashboards.page import Page, Pairs, Picture, Rows, Section
from dashboards.tables import Column, render
from league.commands import explain
from league.commands.ladder import LADDER, TRIED, for_people, notes_on, title_of
from league.commands.status import PLAYERS, WORKERS, Facts, facts
from league.commands.tables import CURVES, MATCHES, NEWEST, PURPOSE, RECORDED
from league.config.schema import ConfigError
from league.liveness import leader, processes
from league.metagame import table as payoff_table
from league.query import Open, Shown, curve_rows, match_rows, snapshot_rows
from league.rated import Row, rating_rows, side_text, unlike_sides, when
from league.standing import Standing
from storage.errors import StorageError
from storage.records import Player

DRAWN = {
    "score": "score in training", "reward": "reward per step", "length": "steps per episode", "entropy": "entropy",
    "explained_variance": "explained variance of the critic",
}  # fmt: skip
"""Figures of learning that have a picture, where they were recorded."""
STEPS = Column("steps", "training steps")
LINEAGE = (
    Column("name", "snapshot", whole=True), Column("parent", "goes on from", whole=True), "player", "origin",
    "iteration", "steps", Column("digest", whole=True),
)  # fmt: skip
OF_A_PAIR = 10
"""Batches of a pair that can be looked at, the newest ones: `league matches` has all."""
LED = Column("match", led="led")
WATCH = Column("watch", "to watch it", typed=True)
SHORT = 12  # hexadecimal digits of a digest that tell snapshots apart


def version(opened: Open) -> str:
    """Changes whenever the page would: with what the store holds, who runs the league and what its workers do."""
    doing = sorted(f"{w.id} {w.status.get('doing', '')}" for w in processes(opened.store, opened.league))
    told = hashlib.sha256("\n".join([leader(opened.store, opened.league) or "", *doing]).encode()).hexdigest()
    return f"{opened.league}:{opened.store.revision(opened.league)}:{told[:SHORT]}"


def page(opened: Open, led: str = "") -> Page:
    """The page of a league as it is now; matches lead to where its server shows them, at `led` and their number."""
    state = version(opened)  # first: what changes while we read is read again
    return Page(f"League {opened.league}", f"Robot League, {opened.store.where}", sections(opened, led), state)


def sections(opened: Open, led: str = "") -> list[Section]:
    """All that is said of a league, in the order of the page."""
    shown, standing, status = opened.shown(), Standing.of(opened.store, opened.league), facts(opened, True)
    points = curve_rows(sorted(opened.points(), key=lambda p: (p.iteration, p.player)))
    steps = {s.name: s.step for s in shown.snapshots if s.player}
    rows = [
        {**row, "steps": steps.get(row["name"])}
        for row in rating_rows(shown.ladders[0], shown.snapshots, shown.players, shown.void_limit)
    ]
    played = _played(opened, led)
    found = {
        ("now", "Who learns now"): _schedule(status, opened.store.now()),
        ("ladder", "Ladder"): _ladder(rows, shown),
        ("ratings", "Ratings over training"): _ratings(rows, shown),
        ("payoff", "Payoff"): _payoff(shown, played, led),
        ("opponents", "Opponents now"): _opponents(opened, standing),
        ("curves", "Learning curves"): _curves(points),
        ("throughput", "Throughput"): _throughput(points, status),
        ("jobs", "Jobs and errors"): _jobs(standing, status),
        ("matches", "Newest matches"): _matches(played, led),
        ("lineage", "Lineage"): _lineage(shown),
    }
    return [Section(id, title, list(parts)) for (id, title), parts in found.items()]


def _table(rows: Sequence[Mapping[str, Any]], columns: Sequence[Column | str], name: str) -> Rows:
    return Rows(render(rows, columns, "html", name), name)


def _schedule(status: Facts, now: float) -> Iterator[str | Rows]:
    runs = f"League {status.league}: {status.runs or 'stopped'}, as of {when(now)}"
    yield "\n".join([runs, *status.stages, *status.phases, *status.lives])
    yield _table(status.players, PLAYERS, "Players")


def _sides(rows: Sequence[Row], shown: Shown) -> Iterator[tuple[str, list[Row]]]:
    """The rows of each side by what it is called; where all are alike, all rows under no name."""
    unlike = unlike_sides(shown.players)
    for roster in unlike:
        yield f" of {side_text(roster)}", [row for row in rows if row["roster"] == roster]
    if not unlike:
        yield "", list(rows)


def _ladder(rows: Sequence[Row], shown: Shown) -> Iterator[str | Picture | Rows]:
    ladder = shown.ladders[0]
    yield "\n".join([f"{title_of(ladder)}.".replace("..", "."), *notes_on(ladder, rows, shown)])
    for name, own in _sides(rows, shown):
        known, merit = _known(own, shown)
        if known:
            which = f"the {figures.BARS} best of {len(known):,}" if len(known) > figures.BARS else f"all {len(known)}"
            told = f"{merit.capitalize()} with 95 % intervals{name}: {which} that are known. {_extremes(known, merit)}"
            yield Picture(figures.ladder(known, merit), told)
        columns = [*(TRIED if ladder.one_team else LADDER), STEPS]
        yield _table(for_people(own), columns, f"Ladder{name}, best first")


def _known(rows: Sequence[Row], shown: Shown) -> tuple[list[Row], str]:
    """Those whose rating says something, and by what they are rated."""
    merit = "success" if shown.ladders[0].one_team else "elo"
    return [row for row in rows if row[merit] is not None and (row["known"] or merit == "success")], merit


def _extremes(known: Sequence[Row], merit: str) -> str:
    digits = 0 if merit == "elo" else 3

    def told(row: Row) -> str:
        at, low, high = (f"{row[key]:.{digits}f}" for key in (merit, *figures.bounds(merit)))
        return f"{row['name']} at {at} ({low} to {high})"

    return f"Best {told(known[0])}, last {told(known[-1])}."


def _ratings(rows: Sequence[Row], shown: Shown) -> Iterator[str | Picture]:
    for name, own in _sides(rows, shown):
        known, merit = _known(own, shown)
        learnt = sorted((row for row in known if row["steps"] is not None), key=lambda row: row["steps"])
        if not learnt:
            yield f"No snapshot{name} has a known rating yet."
            continue
        newest = {row["player"]: row for row in learnt}
        told = ", ".join(f"{p} {row[merit]:.4g} at {row['steps']:,}" for p, row in sorted(newest.items()))
        yield Picture(
            figures.ratings(known, merit),
            f"{merit.capitalize()}{name} over the training steps of each player, with 95 % bands; level lines: what"
            f" does not learn. Newest: {told}. The ladder's table has the figures.",
        )


def _payoff(shown: Shown, played: Sequence[Row], led: str) -> Iterator[str | Picture | Rows | Pairs]:
    if shown.ladders[0].one_team:
        yield "There is one team: nobody meets anybody."
        return
    try:
        found = payoff_table(shown.ladders[0], shown.snapshots, shown.players)
    except StorageError as error:
        yield str(error)
        return
    down, across = figures.busiest(found.games), figures.busiest(found.games.T)
    rows, columns = [found.rows[i] for i in down], [found.columns[j] for j in across]
    scores, games = found.scores[down][:, across], found.games[down][:, across]
    told = "Score of the rows against the columns, a draw counted half; blank where two have not met."
    if len(rows) < len(found.rows) or len(columns) < len(found.columns):
        told += (
            f" {len(rows)} × {len(columns)} of {len(found.rows):,} × {len(found.columns):,} snapshots, those that have"
            " met the most others: `league payoff --format csv` has all."
        )
    yield Picture(figures.payoff(rows, columns, scores, games), f"{told} A click on a cell shows its matches.")
    yield _pairs(rows, columns, played, led)
    cells = [
        {"score %": name, **{other: 100 * x for other, x in zip(columns, line, strict=True)}}
        for name, line in zip(rows, scores.tolist(), strict=True)
    ]
    heads = [Column("score %", whole=True), *(Column(name, decimals=0) for name in columns)]
    yield _table(cells, heads, "Score of the row against the column, in per cent")


def _opponents(opened: Open, standing: Standing) -> Iterator[str | Picture | Rows]:
    try:
        role_of, seed = opened.roles(), opened.setting("seed", otherwise=1)
    except ConfigError as error:
        yield f"This version cannot read the league's settings: {error}."
        return
    alone = True
    for player in standing.players:
        for part in _mixture(explain.explained(role_of(player.role), standing, player, seed), player):
            alone = False
            yield part
    if alone:
        yield "Nobody meets anybody in training: there is one team, or nobody learns now."


def _mixture(found: Mapping[str, Any], player: Player) -> Iterator[Picture | Rows]:
    for team in found["teams"] if found["learns"] else ():
        against = f" in team {team['team']}" if len(found["teams"]) > 1 else ""
        told = f"Whom {player.name} meets{against} by the rule {found['kind']}"
        yield Picture(figures.mixture(team["opponents"]), f"{told}: {team['why']}.")
        yield _table(explain.called(team["opponents"]), explain.columns(team), told)


def _curves(points: Sequence[Row]) -> Iterator[str | Picture | Rows]:
    if not points:
        yield "Nobody has learnt yet."
        return
    known = {key for row in points for key in row}
    for key, title in DRAWN.items():
        if key in known:
            told = f"{title.capitalize()} over the training steps of each player."
            yield Picture(figures.curves(points, key, title), told + _means(points))
    columns = [c for c in CURVES if (c if isinstance(c, str) else c.key) in known]
    yield _table(points[-NEWEST:], columns, f"The newest {len(points[-NEWEST:])} of {len(points):,} iterations")


def _means(points: Sequence[Row]) -> str:
    """What a point of a long curve is."""
    players = [row["player"] for row in points]
    most = max(map(players.count, set(players)))
    return f" A point is a mean over up to {-(-most // figures.POINTS)} iterations." if most > figures.POINTS else ""


def _throughput(points: Sequence[Row], status: Facts) -> Iterator[str | Picture | Rows]:
    timed = [row for row in points if "steps_per_second" in row]
    yield status.share
    if timed:
        newest = {row["player"]: row["steps_per_second"] for row in timed}
        told = ", ".join(f"{player} {rate:,.0f}" for player, rate in sorted(newest.items()))
        picture = figures.curves(timed, "steps_per_second", "steps per second", "seconds", "seconds of training")
        yield Picture(picture, f"Environment steps per second, learning included. Newest: {told}." + _means(timed))
    yield _table(status.workers, WORKERS[:-1], "Workers")  # when they were seen is old in a moment


def _jobs(standing: Standing, status: Facts) -> Iterator[str | Rows]:
    yield f"Jobs: {status.jobs}"
    if status.paused:
        yield "\n".join(["Paused:", *status.paused])
    if status.failed:
        yield "\n".join(["Set aside:", *status.failed])
    rows = [
        {"job": job.id, "kind": job.kind, "state": job.state, "failures": job.failures, "holder": job.holder,
         "last error": (job.error or "").strip().splitlines()[0] if (job.error or "").strip() else None}
        for job in standing.jobs[-NEWEST:]
    ]  # fmt: skip
    columns = ("job", "kind", "state", "failures", "holder", "last error")
    yield _table(rows, columns, "Jobs that wait, are worked on or were set aside")


def _played(opened: Open, led: str) -> list[Row]:
    """The match log, newest first, with what tables for people have beside it."""
    return [
        {**row, "result": f"{row['wins']}-{row['draws']}-{row['losses']}", "created": when(row["created"]),
         "watch": f"league watch {row['match']}" if row["recorded"] else None,
         "led": f"{led}{row['match']}" if row["recorded"] and led else None}
        for row in reversed(match_rows(opened.store.matches(opened.league)))
    ]  # fmt: skip


def _matches(played: Sequence[Row], led: str) -> Iterator[Rows | str]:
    told = "`league watch NUMBER` shows a match that was recorded; a click on a command copies it."
    yield (
        f"A click on the number of a match that was recorded opens it in 3D, in rerun's viewer. {told}" if led else told
    )
    newest = played[:NEWEST]
    columns = [LED if c == "match" else c for c in MATCHES if c != RECORDED]
    columns += [PURPOSE, Column("created", "played", whole=True), WATCH]
    yield _table(newest, columns, f"The newest {len(newest)} of {len(played):,} batches, counted for a")


def _pairs(rows: Sequence[str], columns: Sequence[str], played: Sequence[Row], led: str) -> Pairs:
    """The newest matches of each pair of a heat map."""
    heads = {"match": "match", "a": "a", "b": "b", "result": "w-d-l", "created": "played", "watch": WATCH.title}
    found: dict[str, dict[str, list[list[str]]]] = {}
    for row in played:
        if {row["a"], row["b"]} <= {*rows, *columns}:
            own = found.setdefault(row["a"], {}).setdefault(row["b"], [])
            if len(own) < OF_A_PAIR:
                own.append([str(row[key] or "") for key in heads])
    name = f"Matches of a pair, counted for a, the newest {OF_A_PAIR} of each order"
    return Pairs(rows, columns, list(heads.values()), found, name, led)


def _lineage(shown: Shown) -> Iterator[Picture | Rows | str]:
    rows = [{**row, "digest": row["digest"][:SHORT]} for row in snapshot_rows(shown.snapshots)]
    if not rows:
        yield "There is no snapshot yet."
        return
    children = sum(row["parent"] is not None for row in rows)
    told = f"{len(rows):,} snapshots by their training steps, {children:,} of which go on from another one."
    yield Picture(figures.lineage(rows), told)
    yield _table(rows, LINEAGE, "Snapshots")
