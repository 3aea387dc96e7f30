"""The page of the bench: for each task a table and a figure of all entries, from their files alone."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dashboards.tables import Column, render
from dashboards.web import figures
from dashboards.web.document import FigureBlock, Page, Part, Section, TableBlock
from league.runs.bench import references
from league.runs.bench.metrics import rated
from league.runs.bench.rerating import of_today, references_of
from league.runs.bench.tasks import GAMES, TASKS, Task

Entries = Mapping[Path, Mapping[str, Any]]
PLAYED = (
    Column("rank", decimals=0), Column("entry", no_wrap=True), Column("track", no_wrap=True), "record", "references",
    Column("elo", "Elo", 0), Column("error", "±", 0), Column("range", "lowest to highest"),
    Column("worst score", no_wrap=True), "exploitability", Column("voids", "void %", 2),
    Column("policies", decimals=0), "side", Column("games", "games a pair"),
    Column("population", "population against references", 3), Column("cross_play", "cross-play"),
    Column("seconds", "seconds to 75 %", 0), "package", "commit", Column("about", no_wrap=True),
)  # fmt: skip
EXACT = (
    Column("rank", decimals=0), Column("entry", no_wrap=True), Column("policies", decimals=0),
    Column("exploitability", decimals=6), Column("range", "lowest to highest"), "package", "commit",
    Column("about", no_wrap=True),
)  # fmt: skip


def page(entries: Entries) -> Page:
    """Return the page of these entries, a section for each task that has one."""
    sections = [_section(task, own) for task in TASKS.values() if (own := _own(task, entries))]
    about = (
        f"Entries: {len(entries)}. A rating counts from the mean of a task's public references, which is 1000 Elo, with"
        f" its 95 % interval; a record has {GAMES:,} games against each reference, a trial fewer. Entries of several"
        " policies (seeds) are ranked by their mean. Where references were added since, an entry met fewer of them, and"
        " its worst score is over those. docs/bench.md has the rules."
    )
    if former := [entry for entry in entries.values() if references_of(entry) is None]:
        rows = [{**_common(entry), "task": entry["task"]} for entry in former]
        told = "These entries met references that this version does not know: `league bench` has to play them again."
        sections.append(Section("former", "Former references", [told, _table(rows, (), "Former references")]))
    return Page("Robot League Bench", about, sections)


def _own(task: Task, entries: Entries) -> list[Mapping[str, Any]]:
    """Return the entries of a task that met references which are known, measured among those of today."""
    own = (each for each in entries.values() if each["task"] == task.name)
    return [of_today(each) for each in own if references_of(each) is not None]


def _section(task: Task, own: Sequence[Mapping[str, Any]]) -> Section:
    lacks = f" Missing references: {task.lacks}." if task.lacks else ""
    parts: list[Part] = [f"{task.about}. Arena {task.arena}, configuration {task.config_hash}.{lacks}"]
    if task.exact:
        rows = _ranked([_exact_row(each) for each in own], "exploitability", best=min)
        return Section(task.name, task.name, [*parts, _table(rows, EXACT, task.name)])
    for team in task.teams:
        title = task.name if task.alike else f"{task.name}, {team}"
        rows = _ranked([_played_row(task, each, team) for each in own], "elo", best=max)
        parts += [
            _table(rows, PLAYED, title),
            _ladder(task, own, team, title),
            _table(_scores(task, own, team), (), f"{title}: scores"),
        ]
    return Section(task.name, task.name, parts)


def _policies(task: Task, entry: Mapping[str, Any], team: str) -> list[Mapping[str, Any]]:
    """Return the metrics of an entry's policies for a side."""
    return [each for each in entry["metrics"]["policies"] if task.alike or each["name"].endswith(f":{team}")]


def _played_row(task: Task, entry: Mapping[str, Any], team: str) -> dict[str, Any]:
    own = _policies(task, entry, team)
    elo = np.array([each["rating"]["elo"] for each in own])
    error = np.array([(each["rating"]["high"] - each["rating"]["low"]) / 2 for each in own])
    worst = min((each["worst"] for each in own), key=lambda each: _number(each["score"]))
    population = (entry["metrics"]["relative_population_performance"] or {}).get(team)
    return {
        **_common(entry), "policies": len(own), "side": "both" if task.alike else team, "elo": float(elo.mean()),
        "error": float(np.sqrt((error**2).sum()) / len(own)),
        "range": f"{elo.min():.0f} to {elo.max():.0f}" if len(own) > 1 else None,
        "worst score": f"{_percent(worst)} against {worst['against']}", "exploitability": _attacked(entry, own),
        "seconds": entry["metrics"]["seconds_to_75"],
        "population": population, "cross_play": _cross_play(entry), "track": entry["track"],
        "voids": 100 * float(np.mean([each["voids"] for each in own])),
        "games": entry["games"], "record": "trial" if entry["trial"] else "yes",
        "references": f"{min(len(each['scores']) for each in own)} of {_met_by(task, team)}",
        "ranked": all(each["ranked"] for each in own),
    }  # fmt: skip


def _met_by(task: Task, team: str) -> int:
    """Return the number of references that a policy of this side can meet."""
    return sum(task.alike or each.team != team for each in references.of(task).references)


def _attacked(entry: Mapping[str, Any], own: Sequence[Mapping[str, Any]]) -> str:
    """Return the largest score over one half that an attacker reached, over all policies."""
    names = [each["name"] for each in own]
    found = [each for each in entry["metrics"]["exploitability"] or [] if each["policy"] in names]
    if not found:
        return "not measured"
    most = max(found, key=lambda each: each["score"])
    several, games = len({row["attacker_seed"] for row in entry["attacks"]}), "the games that chose it"
    if any(row.get("again") for row in entry["attacks"]):
        games = "games of its own"
    of = f", the best of {several} in {games}" if several > 1 else ""
    return f"attackers score {_percent(most)} after {most['attacker_steps']:,} steps{of}"


def _cross_play(entry: Mapping[str, Any]) -> str | None:
    """Return how far the seeds of an entry differ in the games between them, in points; None for one seed."""
    if (found := entry["metrics"]["cross_play"]) is None:
        return None
    if "spread" in found:
        return f"{100 * found['spread']:.1f} from ½"
    return f"{100 * found['off_diagonal_less_diagonal']:+.1f} off the diagonal"


def _exact_row(entry: Mapping[str, Any]) -> dict[str, Any]:
    values = [each["exploitability"] for each in entry["metrics"]["policies"]]
    return {
        **_common(entry), "policies": len(values), "exploitability": float(np.mean(values)), "ranked": True,
        "range": f"{min(values):.6f} to {max(values):.6f}" if len(values) > 1 else None,
    }  # fmt: skip


def _common(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {"entry": entry["name"], "package": entry["package"], "commit": entry["commit"], "about": entry["about"]}


def _ranked(rows: Sequence[dict[str, Any]], merit: str, best: Any) -> list[dict[str, Any]]:
    """Return rows in order, the best first; an entry that breaks too many games by itself is last, without a rank."""
    ordered = sorted(rows, key=lambda row: (not row["ranked"], row[merit] if best is min else -row[merit]))
    return [{**row, "rank": i if row["ranked"] else None} for i, row in enumerate(ordered, 1)]


def _ladder(task: Task, own: Sequence[Mapping[str, Any]], team: str, title: str) -> FigureBlock:
    """Return the figure of all ratings of a side, those of the references too."""
    known = references.of(task)
    drawn = [
        {"name": _called(entry, each, own), "player": entry["name"], **each["rating"]}
        for entry in own
        for each in _policies(task, entry, team)
    ]
    side = {each.name for each in known.of(None if task.alike else team)}
    if known.rows:
        found = rated(task, [], known)
        ends = zip(found.names, found.elo.tolist(), found.low.tolist(), found.high.tolist(), strict=True)
        drawn += [
            {"name": name, "player": None, "elo": elo, "low": low, "high": high}
            for name, elo, low, high in ends
            if name in side
        ]
    drawn.sort(key=lambda row: -row["elo"])
    return FigureBlock(figures.ladder(drawn), f"{title}: ratings with 95 % intervals; fixed are the references.")


def _scores(task: Task, own: Sequence[Mapping[str, Any]], team: str) -> list[dict[str, Any]]:
    """Return a row for each policy with its score against each reference, in per cent."""
    return [
        {"policy": _called(entry, each, own)} | {row["against"]: _percent(row) for row in each["scores"]}
        for entry in own
        for each in _policies(task, entry, team)
    ]


def _called(entry: Mapping[str, Any], policy: Mapping[str, Any], own: Sequence[Mapping[str, Any]]) -> str:
    """Return the name of a policy on the page; two entries may have one name."""
    twins = [each for each in own if each["name"] == entry["name"]]
    number = f" ({twins.index(entry) + 1})" if len(twins) > 1 else ""
    return f"{entry['name']}{number} {policy['name']}"


def _table(rows: Sequence[dict[str, Any]], columns: Sequence[Column | str], title: str) -> TableBlock:
    return TableBlock(render(rows, columns, "html", title), title)


def _number(value: float | None) -> float:
    return -1.0 if value is None else value


def _percent(score: Mapping[str, Any]) -> str:
    if score["score"] is None:
        return "all void"
    return f"{100 * score['score']:.1f} % ({100 * score['low']:.1f}-{100 * score['high']:.1f})"
