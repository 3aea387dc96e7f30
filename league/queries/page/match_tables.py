"""Tables of matches on the page: the newest, and those of a pair that its reader chooses."""

from collections.abc import Iterator, Sequence
from itertools import combinations

from dashboards.tables import Column, render
from dashboards.web.document import PairTable, TableBlock
from league.queries.columns import PURPOSE, RECORDED, match_columns, result_text
from league.queries.query import match_rows
from league.queries.ratings.rating_rows import Row, when
from storage.records import Match, RankedMatch

OF_A_PAIR = 10
"""Number of a pair's newest batches that are listed: `league matches` has all."""
LINKED_MATCH = Column("match", link_key="led")
WATCH = Column("watch", "to watch it", is_command=True)


def played(matches: Sequence[Match | RankedMatch], link_prefix: str) -> list[Row]:
    """Return the match log, newest first, with the further columns of tables for people."""
    return [
        {**row, "result": result_text(row), "created": when(row["created"]),
         "watch": f"league watch {row['match']}" if row["recorded"] else None,
         "led": f"{link_prefix}{row['match']}" if row["recorded"] and link_prefix else None}
        for row in reversed(match_rows(matches))
    ]  # fmt: skip


def newest_matches(newest: Sequence[Row], total: int, link_prefix: str) -> Iterator[TableBlock | str]:
    """Yield the table of the newest of all batches, and how its matches are watched."""
    caption = "`league watch NUMBER` shows a match that was recorded; a click on a command copies it."
    yield (
        f"A click on the number of a match that was recorded opens it in 3D, in rerun's viewer. {caption}"
        if link_prefix
        else caption
    )
    columns = [LINKED_MATCH if c == "match" else c for c in match_columns(newest) if c != RECORDED]
    columns += [PURPOSE, Column("created", "played", no_wrap=True), WATCH]
    counted = "" if newest and all(row.get("lineup") for row in newest) else ", counted for a"
    name = f"The newest {len(newest)} of {total:,} batches{counted}"
    yield TableBlock(render(newest, columns, "html", name), name)


def pair_table(rows: Sequence[str], columns: Sequence[str], played: Sequence[Row], link_prefix: str) -> PairTable:
    """Return the newest matches of each pair of a heat map."""
    heads = {"match": "match", "a": "a", "b": "b", "result": "w-d-l", "created": "played", "watch": WATCH.title}
    found: dict[str, dict[str, list[list[str]]]] = {}
    for row in played:
        for a, b, result in _met_in(row):
            if not {a, b} <= {*rows, *columns}:
                continue
            own = found.setdefault(a, {}).setdefault(b, [])
            if len(own) < OF_A_PAIR:
                cells = {**row, "a": a, "b": b, "result": result}
                own.append([str(cells[key] or "") for key in heads])
    name = f"Matches of a pair, counted for a, the newest {OF_A_PAIR} of each order"
    return PairTable(rows, columns, list(heads.values()), found, name, link_prefix)


def _met_in(row: Row) -> list[tuple[str, str, str | None]]:
    """Return the pairs that met in a match, with their result; in a lineup that is the mean ranks of all teams."""
    if not row.get("lineup"):
        return [(row["a"], row["b"], row["result"])]
    names = dict.fromkeys(row["lineup"].split(", "))
    return [(a, b, f"{row['lineup']}: {row['mean_ranks'] or ''}") for a, b in combinations(names, 2)]
