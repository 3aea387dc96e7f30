"""`league verify`: check that all data named in a store exists, is intact and has possible values."""

import json
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Literal

from dashboards.tables import Column, render
from league.commands.options import STORE, parse
from league.commands.progress_bar import Progress
from league.config.durations import check_duration, seconds
from league.state.jobs import references
from storage.maintenance.findings import Kind, StoreFinding, VerificationReport
from storage.maintenance.verify import verify as examine

SHOWN = 20  # most findings of a kind that a table lists one by one
COLUMNS = (Column("kind", "", no_wrap=True), Column("place", "what"), "problem")
ORDER: tuple[Kind, ...] = ("missing", "corrupt", "orphaned")


@dataclass(frozen=True)
class VerifyOptions:
    """The store, and the format of the output."""

    store: str = STORE
    """The store: a folder, or a URL such as sqlite:///runs/league.db or postgresql://host/league."""
    blobs: str | None = None
    """Place of the store's policies and recordings (none: ROBOT_LEAGUE_BLOBS if set, else beside a SQLite store)."""
    age: str = field(default="1h", metadata={"valid": check_duration})
    """Age above which blobs that no row names are reported; a worker may be about to name a younger one."""
    format: Literal["table", "json"] = "table"
    """table for people, json for programs."""


def verify(args: list[str]) -> int:
    """Check a store; return 0 if nothing is missing, corrupt or orphaned, otherwise 1."""
    what = "Read every row, blob and recording of a store: what is missing, corrupt or orphaned. Changes nothing."
    options = parse(VerifyOptions, args, "verify", what)
    progress = Progress("verifying")
    report = examine(options.store, options.blobs, seconds(options.age), progress.tell, references)
    progress.end()
    print(_json(report) if options.format == "json" else _table(report))
    return 1 if report.findings else 0


def _json(report: VerificationReport) -> str:
    summary: dict[str, Any] = {
        "store": report.where, "rows": report.rows, "blobs": report.blobs, "recordings": report.recordings,
        "orphans_told": report.references_known, "dropped": report.dropped, "dropped_bytes": report.dropped_bytes,
        "findings": [finding._asdict() for finding in report.findings],
    }  # fmt: skip
    return json.dumps(summary, indent=2)


def _table(report: VerificationReport) -> str:
    parts = [
        f"{report.where}: {report.rows:,} rows and {report.blobs:,} blobs that they name, {report.recordings:,} of them"
        " recordings."
    ]
    if report.dropped:
        what = f"{report.dropped:,} blobs ({report.dropped_bytes:,} bytes)"
        parts.append(f"{what} of what is no longer kept, such as old checkpoints, can go: `league thin` removes them.")
    if not report.references_known:
        parts.append("Not all rows could be read, so it is unknown which blobs are orphaned.")
    if not report.findings:
        return "\n".join([*parts, "Nothing is missing, orphaned or corrupt."])
    rows = [row for kind in ORDER for row in _rows([f for f in report.findings if f.kind == kind])]
    counts = Counter(finding.kind for finding in report.findings)
    parts.append(render(rows, COLUMNS))
    parts.append(", ".join(f"{counts[kind]:,} {kind}" for kind in ORDER if counts[kind]) + ".")
    if counts["orphaned"]:
        damage = "" if report.damaged else "Nothing is missing or corrupt. "
        parts.append(
            f"{damage}What is orphaned takes space and does no harm: `league thin` removes it when it is a day old."
        )
    return "\n".join(parts)


def _rows(findings: list[StoreFinding]) -> list[dict[str, Any]]:
    """Return findings of one kind for a table: the first ones and the number of others; of orphans only the number."""
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
