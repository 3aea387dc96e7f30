"""`league verify`: whether all that a store says it has is there, whole and possible."""

import json
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Literal

from dashboards.tables import Column, render
from league.commands.moving import Progress
from league.commands.options import STORE, parse
from league.config.durations import seconds
from league.jobs import references
from storage.findings import Finding, Kind, Report
from storage.verifying import verify as examine

SHOWN = 20  # findings of a kind that a table tells one by one
COLUMNS = (Column("kind", "", whole=True), Column("place", "what"), "problem")
ORDER: tuple[Kind, ...] = ("missing", "corrupt", "orphaned")


def lasts(value: str) -> None:
    """Raise ValueError unless the text is a span of time."""
    seconds(value)


@dataclass(frozen=True)
class VerifyOptions:
    """Which store, and how to print what is found."""

    store: str = STORE
    """The store: a folder, or a URL such as sqlite:///runs/league.db or postgresql://host/league."""
    blobs: str | None = None
    """Where the store keeps policies and recordings (none: ROBOT_LEAGUE_BLOBS if set, else beside a SQLite store)."""
    age: str = field(default="1h", metadata={"valid": lasts})
    """Blobs that no row names are told when they are older; a worker may be about to name a young one."""
    format: Literal["table", "json"] = "table"
    """table for people, json for programs."""


def verify(args: list[str]) -> int:
    """Look through a store; 0 where nothing is missing, corrupt or orphaned, 1 where something is."""
    what = "Read every row, blob and recording of a store: what is missing, corrupt or orphaned. Changes nothing."
    options = parse(VerifyOptions, args, "verify", what)
    progress = Progress("verifying")
    report = examine(options.store, options.blobs, seconds(options.age), progress.tell, references)
    progress.end()
    print(_json(report) if options.format == "json" else _table(report))
    return 1 if report.findings else 0


def _json(report: Report) -> str:
    told: dict[str, Any] = {
        "store": report.where, "rows": report.rows, "blobs": report.blobs, "recordings": report.recordings,
        "orphans_told": report.told, "dropped": report.dropped, "dropped_bytes": report.dropped_bytes,
        "findings": [finding._asdict() for finding in report.findings],
    }  # fmt: skip
    return json.dumps(told, indent=2)


def _table(report: Report) -> str:
    parts = [
        f"{report.where}: {report.rows:,} rows and {report.blobs:,} blobs that they name, {report.recordings:,} of them"
        " recordings."
    ]
    if report.dropped:
        what = f"{report.dropped:,} blobs ({report.dropped_bytes:,} bytes)"
        parts.append(f"{what} of what is no longer kept, such as old checkpoints, can go: `league thin` removes them.")
    if not report.told:
        parts.append("Not all rows could be read, so nobody knows which blobs are orphaned.")
    if not report.findings:
        return "\n".join([*parts, "Nothing is missing, orphaned or corrupt."])
    rows = [row for kind in ORDER for row in _rows([f for f in report.findings if f.kind == kind])]
    counts = Counter(finding.kind for finding in report.findings)
    parts.append(render(rows, COLUMNS))
    parts.append(", ".join(f"{counts[kind]:,} {kind}" for kind in ORDER if counts[kind]) + ".")
    if counts["orphaned"]:
        damage = "" if report.damaged else "Nothing is missing or corrupt. "
        parts.append(f"{damage}What is orphaned takes space and does no harm: `league thin` removes it.")
    return "\n".join(parts)


def _rows(findings: list[Finding]) -> list[dict[str, Any]]:
    """Findings of one kind for a table: the first ones, and how many more there are; of orphans only their number."""
    if findings and findings[0].kind == "orphaned":
        problems = dict.fromkeys(finding.problem for finding in findings)
        grouped = {problem: [f for f in findings if f.problem == problem] for problem in problems}
        return [
            {"kind": "orphaned", "place": f"{len(some):,} {some[0].place.partition(' ')[0]}{'s' * (len(some) > 1)}",
             "problem": f"{problem} ({sum(f.bytes for f in some):,} bytes)"}
            for problem, some in grouped.items()
        ]  # fmt: skip
    rows = [finding._asdict() for finding in findings[:SHOWN]]
    if (more := len(findings) - SHOWN) > 0:
        problem = "--format json tells of each"
        rows.append({"kind": findings[0].kind, "place": f"and {more:,} more", "problem": problem})
    return rows
