"""Learning curves read in columns: a record for each of a million iterations takes five times as long."""

import json
import math
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from operator import itemgetter
from typing import Any

from storage.records import CurveColumns


def curve_pieces(parts: Iterable[Sequence[Any]], metrics: Sequence[str]) -> Iterator[tuple[str, CurveColumns]]:
    """Yield players with successive pieces of their curves.

    Args:
        parts: rows of player, iteration, step, seconds and values as JSON text, those of a player together.
        metrics: the names of the values to keep.

    Raises:
        TypeError, ValueError: a row is damaged.
    """
    for rows in parts:
        for player, own in groupby(rows, key=itemgetter(0)):
            _, iterations, steps, seconds, texts = zip(*own, strict=True)
            values = json.loads(f"[{','.join(texts)}]")  # one call for all rows
            if len(values) != len(texts) or not all(isinstance(each, dict) for each in values):
                raise ValueError("values is no object")
            recorded = set[str]().union(*values)
            columns = {name: _column(name, values, name in recorded) for name in metrics}
            yield (
                player,
                CurveColumns(array("q", iterations), array("q", steps), array("d", seconds), columns, recorded),
            )


def joined(pieces: Iterable[tuple[str, CurveColumns]]) -> dict[str, CurveColumns]:
    """Return whole curves by player, in the order of their first pieces."""
    found: dict[str, CurveColumns] = {}
    for player, piece in pieces:
        if player not in found:
            found[player] = piece
            continue
        whole = found[player]
        whole.iterations.extend(piece.iterations)
        whole.steps.extend(piece.steps)
        whole.seconds.extend(piece.seconds)
        for name, values in piece.values.items():
            whole.values[name].extend(values)
        whole.recorded.update(piece.recorded)
    return found


def _column(name: str, values: Sequence[Mapping[str, Any]], recorded: bool) -> "array[float]":
    if not recorded:
        return array("d", [math.nan]) * len(values)
    try:
        return array("d", map(itemgetter(name), values))  # where every row has it, in a third of the time
    except (KeyError, TypeError):
        return array("d", [math.nan if (x := each.get(name)) is None else x for each in values])
