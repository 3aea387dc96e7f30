"""Rows as text for a terminal, a program or a spreadsheet.

Tables hold no escape codes, so they read the same in a terminal, a pipe and a file; but for those that are asked for in
a terminal's colours.
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

if TYPE_CHECKING:
    import pandas as pd

Format = Literal["table", "json", "csv", "html"]
MISSING = "–"
FOLDED = 8  # columns that text needs at least
GAP = 3  # columns between two of a table's
PUNCTUATION = "–—…×±"  # that takes one column, beside Latin letters


@dataclass(frozen=True)
class Column:
    """Which value of a row to show, under which heading, and with how many decimals in a table."""

    key: str
    title: str = ""  # the key if empty
    decimals: int | None = None  # None: by the size of the column's largest value
    whole: bool = False  # never broken into two lines, whatever the width
    typed: bool = False  # commands: HTML has a button for each, see `command`
    led: str = ""  # the key of where HTML has a cell lead to, in rows where that says something


def render(
    rows: "pd.DataFrame | Sequence[Mapping[str, Any]]",
    columns: Sequence[Column | str] = (),
    format: Format = "table",
    title: str = "",
    width: int | None = None,
    lit: bool = False,
) -> str:
    """Return rows as text without a newline at its end.

    `columns` chooses and orders what is shown; without it, every key is, in the order of its first appearance. A data
    frame's index is shown if it has a name. `json` is a list of objects and `csv` has a header line, both under the
    keys and with full precision; not-a-number and infinity become null in JSON, which has no word for them. `html` is a
    table element with the cells of a `table`; the first column that is `whole` names its row. `title` is for both;
    `width` is for a `table`, that of the terminal without it, or 80 without one. Nothing is ever cut: text is folded,
    and where even so the columns do not fit side by side the last ones are left out, and named below. Where `lit`, a
    `table` has a terminal's colours: a row that of its key `style`, in rich's words.

    Raises ValueError for an unknown format.
    """
    records = _records(rows)
    keys = list(dict.fromkeys(key for record in records for key in record))
    chosen = [c if isinstance(c, Column) else Column(c) for c in columns or keys]
    match format:
        case "json":
            objects = [{c.key: _jsonable(record.get(c.key)) for c in chosen} for record in records]
            return json.dumps(objects, indent=2, ensure_ascii=False, default=str)
        case "csv":
            out = io.StringIO()
            lines = csv.writer(out, lineterminator="\n")
            lines.writerow(c.key for c in chosen)
            lines.writerows([record.get(c.key) for c in chosen] for record in records)
            return out.getvalue().removesuffix("\n")
        case "table":
            return _table(records, chosen, title, width or shutil.get_terminal_size().columns, lit)
        case "html":
            return _html(records, chosen, title)
    raise ValueError(f"there is no format {format!r}; choose one of: {', '.join(get_args(Format))}")


def _records(rows: Any) -> list[dict[str, Any]]:
    """Rows as dicts of Python values; None stands for whatever pandas holds to be missing."""
    if hasattr(rows, "to_dict"):
        if any(name is not None for name in rows.index.names):
            rows = rows.reset_index()
        rows = rows.astype(object).where(rows.notna(), None).to_dict("records")
    return [{key: _python(value) for key, value in row.items()} for row in rows]


def _python(value: Any) -> Any:
    return value.item() if hasattr(value, "item") and not getattr(value, "shape", ()) else value


def _jsonable(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _table(records: list[dict[str, Any]], columns: list[Column], title: str, width: int, lit: bool) -> str:
    columns, left_out = _fitting(records, columns, width)
    cells = [[record.get(c.key) for record in records] for c in columns]
    texts = [_texts(values, column.decimals) for column, values in zip(columns, cells, strict=True)]
    heads = [column.title or column.key for column in columns]
    if not lit and _is_plain(heads, texts, width):
        lines = [*textwrap.wrap(title, width), *_plain(heads, texts, list(map(_is_numeric, cells)))]
    else:
        styles = [record.get("style") for record in records] if lit else None
        lines = _folded(columns, cells, texts, title, width, styles)
    if left_out:
        names = ", ".join(c.title or c.key for c in left_out)
        lines += textwrap.wrap(f"{width} columns are too few for: {names}", width)
    return "\n".join([*lines, *([] if records else ["(none)"])]).strip("\n")


def _html(records: list[dict[str, Any]], columns: list[Column], title: str) -> str:
    cells = [[record.get(c.key) for record in records] for c in columns]
    texts = [_texts(values, column.decimals) for column, values in zip(columns, cells, strict=True)]
    kinds = [' class="number"' if _is_numeric(values) else "" for values in cells]
    shown = [list(map(command if c.typed else escape, column)) for c, column in zip(columns, texts, strict=True)]
    for c, column in zip(columns, shown, strict=True):
        if c.led:
            column[:] = [link(str(row.get(c.led) or ""), text) for row, text in zip(records, column, strict=True)]
    heads = [f'<th scope="col"{kind}>{escape(c.title or c.key)}</th>' for c, kind in zip(columns, kinds, strict=True)]
    naming = next((i for i, c in enumerate(columns) if c.whole), None)
    tags = [("th", ' scope="row"') if i == naming else ("td", kind) for i, kind in enumerate(kinds)]
    rows = [
        "".join(f"<{tag}{about}>{text}</{tag}>" for (tag, about), text in zip(tags, row, strict=True))
        for row in zip(*shown, strict=True)
    ] or [f'<td colspan="{len(columns)}">(none)</td>']
    lines = "\n".join(f"<tr>{row}</tr>" for row in rows)
    caption = f"<caption>{escape(title)}</caption>" if title else ""
    return f"<table>{caption}<thead><tr>{''.join(heads)}</tr></thead>\n<tbody>\n{lines}\n</tbody></table>"


def command(text: str) -> str:
    """A command in HTML, as a button that copies it; nothing where it is missing."""
    return "" if text == MISSING else f'<button type="button" class="copy">{escape(text)}</button>'


def link(to: str, markup: str) -> str:
    """A link to a page of its own, in HTML; the bare markup where it leads nowhere."""
    return f'<a href="{escape(to)}" target="_blank" rel="noopener">{markup}</a>' if to else markup


def _is_plain(heads: list[str], texts: list[list[str]], width: int) -> bool:
    """Whether a table fits with no text folded, and every character takes one column."""
    widths = [max(map(len, (head, *column))) for head, column in zip(heads, texts, strict=True)]
    whole = "".join((*heads, *(text for column in texts for text in column)))
    one_wide = whole.isascii() or all(ord(c) < 0x300 or c in PUNCTUATION for c in whole)
    return one_wide and whole.isprintable() and sum(widths) + GAP * (len(widths) - 1) + 1 <= width


def _plain(heads: list[str], texts: list[list[str]], numeric: list[bool]) -> list[str]:
    """What `_folded` gives where nothing is folded, in a twentieth of its time."""
    cells = [
        [text.rjust(most) if right else text.ljust(most) for text in (head, *column)]
        for head, column, right in zip(heads, texts, numeric, strict=True)
        for most in [max(map(len, (head, *column)))]
    ]
    head, *rows = (" " + (" " * GAP).join(row) for row in zip(*cells, strict=True))
    return ["", head.rstrip(), " " + "─" * (len(head) - 1), *(row.rstrip() for row in rows), ""]


def _folded(
    columns: list[Column],
    cells: list[list[Any]],
    texts: list[list[str]],
    title: str,
    width: int,
    styles: Sequence[str | None] | None = None,
) -> list[str]:
    """By rich; in its colours where there are styles, one for each row."""
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
        whole = is_number or column.whole
        table.add_column(column.title or column.key, justify=justify, no_wrap=whole, overflow="fold")
    for i, row in enumerate(zip(*texts, strict=True)):
        table.add_row(*row, style=styles[i] if styles else None)
    out = io.StringIO()
    lit = styles is not None
    colours = "auto" if lit else None  # by what the terminal says that it knows
    console = Console(
        file=out, width=width, color_system=colours, force_terminal=lit, markup=False, highlight=False, emoji=False
    )
    console.print(table)
    return [line.rstrip() for line in out.getvalue().splitlines()]


def _fitting(records: list[dict[str, Any]], columns: list[Column], width: int) -> tuple[list[Column], list[Column]]:
    """The columns that fit side by side, the first ones, and the others. Text that may be folded needs little room."""
    needed = 0
    for i, column in enumerate(columns):
        values = [record.get(column.key) for record in records]
        longest = max(map(len, [column.title or column.key, *_texts(values, column.decimals)]))
        needed += (longest if column.whole or _is_numeric(values) else min(longest, FOLDED)) + (GAP if i else 2)
        if needed > width and i:
            return columns[:i], columns[i:]
    return columns, []


def _is_numeric(values: list[Any]) -> bool:
    return any(map(_is_number, values)) and all(v is None or _is_number(v) for v in values)


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def _texts(values: list[Any], decimals: int | None) -> list[str]:
    """A column's cells. Numbers share their decimals; whole numbers are grouped once one has five digits."""
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
            texts.append(f"{value:{group}.{decimals}f}")
        else:
            texts.append(str(value))
    return texts
