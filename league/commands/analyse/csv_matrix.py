"""Payoff matrices in users' CSV files."""

import math

import numpy as np

from league.config import text_files
from league.config.schema import ConfigError


def read(path: str) -> tuple[tuple[str, ...], np.ndarray]:
    """Read names and payoffs (N, N) from a CSV file; rows may begin with their names, as in `league payoff`'s output.

    Fields are separated by commas, semicolons or tabs; without commas as separators, a comma may be the decimal point.

    Raises ConfigError, one line that names the wrong place.
    """
    text = text_files.read(path)
    separator = text_files.separator(text)
    lines = [(line, [cell.strip() for cell in row]) for line, row in text_files.rows(text, separator, path)]
    if len(lines) < 2:
        raise ConfigError(("file",), f"{path}: no payoffs; a header row of names, then a row for each of them")
    named = lines[0][1][0] == ""  # then each row begins with its name
    names = tuple(lines[0][1][named:])
    if len(set(names)) < len(names) or "" in names:
        raise ConfigError(("file",), f"{path}:1: each strategy needs a name of its own, not {', '.join(names)}")
    if len(lines) - 1 != len(names):
        raise ConfigError(("file",), f"{path}: {len(names)} names but {len(lines) - 1} rows; one row for each name")
    payoffs = np.zeros((len(names), len(names)))
    for i, (line, cells) in enumerate(lines[1:]):
        if named and cells[0] != names[i]:
            raise ConfigError(("file",), f"{path}:{line}: the row of {names[i]} begins with {cells[0]!r}")
        if len(cells) - named != len(names):
            raise ConfigError(("file",), f"{path}:{line}: {len(cells) - named} payoffs, but {len(names)} names")
        for j, cell in enumerate(cells[named:]):
            number = cell if separator == "," else cell.replace(",", ".")
            payoffs[i, j] = _number(number, f"{path}:{line}: the payoff of {names[i]} against {names[j]}")
    return names, payoffs


def _number(cell: str, what: str) -> float:
    if not cell:
        raise ConfigError(("file",), f"{what} is missing: the two have not met; give a number")
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or abs(value) > 1e150:
        raise ConfigError(("file",), f"{what} is {cell[:40]!r}; it must be a number")
    return value
