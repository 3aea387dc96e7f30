"""Rows as text for a terminal, a program or a spreadsheet.

Tables contain no escape codes, so they read the same in a terminal, a pipe and a file, unless a terminal's colours are
requested.
"""

import csv
import io
import json
import math
import numbers
import shutil
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, Literal, get_args

from dashboards.untrusted_text import csv_cell, visible

if TYPE_CHECKING:
    import pandas as pd

Format = Literal["table", "json", "csv", "html"]
MISSING = "–"
FOLDED = 8  # minimum width of folded text
GAP = 3  # characters between two columns
PUNCTUATION = "–—…×±"  # one column wide, like Latin letters


@dataclass(frozen=True)
class Column:
    """A value of a row to show, with its heading and, in a table, its decimals."""

    key: str
    title: str = ""  # heading; the key if empty
    decimals: int | None = None  # None: by the size of the column's largest value
    no_wrap: bool = False  # never broken into two lines
    is_command: bool = False  # a command: HTML shows a button, see `copy_button`
    link_key: str = ""  # key of the target that HTML links a cell to, if the row has one


def render(
    rows: "pd.DataFrame | Sequence[Mapping[str, Any]]",
    columns: Sequence[Column | str] = (),
    format: Format = "table",
    title: str = "",
    width: int | None = None,
    colour: bool = False,
) -> str:
    """Return rows as text without a newline at its end.

    Args:
        rows: a data frame, whose index is shown if it has a name, or mappings.
        columns: the columns to show, in order; if empty, every key in the order of first appearance.
        format: `table`; `json`, a list of objects in pure ASCII; `csv`, with a header line; or `html`, a table
            element with the cells of a `table`, in which the first `no_wrap` column names its row. JSON and CSV have
            the keys and full precision; JSON has null for not-a-number and infinity.
        title: of a `table` or `html`.
        width: of a `table`; by default the terminal's, or 80 without a terminal. Text is folded and never cut. Columns
            at the end that still do not fit are left out, and named below the table.
        colour: give a `table` a terminal's colours; a row's key `style` has its style, in rich's terms.

    Text is printed as `dashboards.untrusted_text` makes it safe, in JSON exactly.

    Raises:
        ValueError: the format is unknown.
    """
    records = _records(rows)
    keys = list(dict.fromkeys(key for record in records for key in record))
    chosen = [c if isinstance(c, Column) else Column(c) for c in columns or keys]
    match format:
        case "json":
            objects = [{c.key: _jsonable(record.get(c.key)) for c in chosen} for record in records]
            return json.dumps(objects, indent=2, default=str)
        case "csv":
            out = io.StringIO()
            lines = csv.writer(out, lineterminator="\n")
            lines.writerow(csv_cell(c.key) for c in chosen)
            lines.writerows([csv_cell(record.get(c.key)) for c in chosen] for record in records)
            return out.getvalue().removesuffix("\n")
        case "table":
            return _table(records, chosen, title, width or shutil.get_terminal_size().columns, colour)
        case "html":
            return _html(records, chosen, title)
    raise ValueError(f"there is no format {format!r}; choose one of: {', '.join(get_args(Format))}")


def _records(rows: Any) -> list[dict[str, Any]]:
    """Return rows as dicts of Python values, with None for values that pandas treats as missing."""
    if hasattr(rows, "to_dict"):
        if any(name is not None for name in rows.index.names):
            rows = rows.reset_index()
        rows = rows.astype(object).where(rows.notna(), None).to_dict("records")
    return [{key: _python(value) for key, value in row.items()} for row in rows]


def _python(value: Any) -> Any:
    return value.item() if hasattr(value, "item") and not getattr(value, "shape", ()) else value


def _jsonable(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _table(records: list[dict[str, Any]], columns: list[Column], title: str, width: int, colour: bool) -> str:
    columns, left_out = _columns_that_fit(records, columns, width)
    cells = [[record.get(c.key) for record in records] for c in columns]
    texts = [_texts(values, column.decimals) for column, values in zip(columns, cells, strict=True)]
    heads = [_head(column) for column in columns]
    title = " ".join(map(visible, title.split()))
    if not colour and _is_plain(heads, texts, width):
        lines = [*textwrap.wrap(title, width), *_plain_table(heads, texts, list(map(_is_numeric, cells)))]
    else:
        styles = [record.get("style") for record in records] if colour else None
        lines = _rich_table(columns, cells, texts, title, width, styles)
    if left_out:
        names = ", ".join(map(_head, left_out))
        lines += textwrap.wrap(f"{width} columns are too few for: {names}", width)
    return "\n".join([*lines, *([] if records else ["(none)"])]).strip("\n")


def _html(records: list[dict[str, Any]], columns: list[Column], title: str) -> str:
    cells = [[record.get(c.key) for record in records] for c in columns]
    texts = [_texts(values, column.decimals) for column, values in zip(columns, cells, strict=True)]
    kinds = [
        ' class="number"' if _is_numeric(values) else ' class="whole"' if c.no_wrap else ""
        for c, values in zip(columns, cells, strict=True)
    ]
    marked = [
        list(map(copy_button if c.is_command else escape, column)) for c, column in zip(columns, texts, strict=True)
    ]
    for c, column in zip(columns, marked, strict=True):
        if c.link_key:
            column[:] = [link(str(row.get(c.link_key) or ""), text) for row, text in zip(records, column, strict=True)]
    heads = [f'<th scope="col"{kind}>{escape(_head(c))}</th>' for c, kind in zip(columns, kinds, strict=True)]
    naming = next((i for i, c in enumerate(columns) if c.no_wrap), None)
    tags = [("th", ' scope="row"') if i == naming else ("td", kind) for i, kind in enumerate(kinds)]
    rows = [
        "".join(f"<{tag}{about}>{text}</{tag}>" for (tag, about), text in zip(tags, row, strict=True))
        for row in zip(*marked, strict=True)
    ] or [f'<td colspan="{len(columns)}">(none)</td>']
    lines = "\n".join(f"<tr>{row}</tr>" for row in rows)
    caption = f"<caption>{escape(visible(title))}</caption>" if title else ""
    return f"<table>{caption}<thead><tr>{''.join(heads)}</tr></thead>\n<tbody>\n{lines}\n</tbody></table>"


def copy_button(text: str) -> str:
    """Return a command in HTML, as a button that copies it; empty where it is missing."""
    return "" if text == MISSING else f'<button type="button" class="copy">{escape(text)}</button>'


def link(to: str, markup: str) -> str:
    """Return a link to a page of its own, in HTML; the bare markup without a target."""
    return f'<a href="{escape(to)}" target="_blank" rel="noopener">{markup}</a>' if to else markup


def _is_plain(heads: list[str], texts: list[list[str]], width: int) -> bool:
    """Return whether a table fits without folded text and every character is one column wide."""
    widths = [max(map(len, (head, *column))) for head, column in zip(heads, texts, strict=True)]
    whole = "".join((*heads, *(text for column in texts for text in column)))
    one_wide = whole.isascii() or all(ord(c) < 0x300 or c in PUNCTUATION for c in set(whole))
    return one_wide and whole.isprintable() and sum(widths) + GAP * (len(widths) - 1) + 1 <= width


def _plain_table(heads: list[str], texts: list[list[str]], numeric: list[bool]) -> list[str]:
    """Return the same as `_rich_table` for a table without folded text, in a twentieth of the time."""
    cells = [
        [text.rjust(most) if right else text.ljust(most) for text in (head, *column)]
        for head, column, right in zip(heads, texts, numeric, strict=True)
        for most in [max(map(len, (head, *column)))]
    ]
    head, *rows = (" " + (" " * GAP).join(row) for row in zip(*cells, strict=True))
    return ["", head.rstrip(), " " + "─" * (len(head) - 1), *(row.rstrip() for row in rows), ""]


def _rich_table(
    columns: list[Column],
    cells: list[list[Any]],
    texts: list[list[str]],
    title: str,
    width: int,
    styles: Sequence[str | None] | None = None,
) -> list[str]:
    """Return lines drawn by rich; in colours if there are styles, one for each row."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(
        box=box.SIMPLE_HEAD, pad_edge=False, title=title or None, title_justify="left", title_style="bold",
        header_style="bold",
    )  # fmt: skip
    for column, values in zip(columns, cells, strict=True):
        is_number = _is_numeric(values)
        justify = "right" if is_number else "left"
        whole = is_number or column.no_wrap
        table.add_column(_head(column), justify=justify, no_wrap=whole, overflow="fold")
    for i, row in enumerate(zip(*texts, strict=True)):
        table.add_row(*row, style=styles[i] if styles else None)
    out = io.StringIO()
    colour = styles is not None
    colours = "auto" if colour else None  # as the terminal supports
    console = Console(
        file=out, width=width, color_system=colours, force_terminal=colour, markup=False, highlight=False, emoji=False
    )
    console.print(table)
    return [line.rstrip() for line in out.getvalue().splitlines()]


def _columns_that_fit(
    records: list[dict[str, Any]], columns: list[Column], width: int
) -> tuple[list[Column], list[Column]]:
    """Return the first columns that fit side by side, and the others. Foldable text needs little width."""
    needed = 0
    for i, column in enumerate(columns):
        values = [record.get(column.key) for record in records]
        longest = max(map(len, [_head(column), *_texts(values, column.decimals)]))
        needed += (longest if column.no_wrap or _is_numeric(values) else min(longest, FOLDED)) + (GAP if i else 2)
        if needed > width and i:
            return columns[:i], columns[i:]
    return columns, []


def _head(column: Column) -> str:
    return visible(column.title or column.key)


def _is_numeric(values: list[Any]) -> bool:
    return any(map(_is_number, values)) and all(v is None or _is_number(v) for v in values)


def _is_number(value: Any) -> bool:
    kind = type(value)  # called for every cell, and isinstance of an abstract class is slow
    return kind is float or kind is int or (kind is not bool and isinstance(value, numbers.Real))


def _texts(values: list[Any], decimals: int | None) -> list[str]:
    """Return a column's cells as text. Numbers share their decimals; integers are grouped if any has five digits."""
    finite = [abs(v) for v in values if _is_number(v) and math.isfinite(v)]
    largest = max(finite, default=0)
    if decimals is None:
        decimals = 0 if largest >= 100 else 1 if largest >= 10 else 2 if largest >= 1 else 3
    group = "," if largest >= 10_000 else ""
    texts = []
    for value in values:
        if value is None or (isinstance(value, float) and math.isnan(value)):
            texts.append(MISSING)
        elif isinstance(value, bool):
            texts.append("yes" if value else "no")
        elif isinstance(value, int):
            texts.append(f"{value:{group}d}")
        elif _is_number(value):
            texts.append(f"{value:z{group}.{decimals}f}")  # z: no minus before a zero
        else:
            texts.append(visible(str(value)))
    return texts
