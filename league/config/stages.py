"""The stages of a curriculum: tables [[stages]], each a name and settings that override those of the league.

    [[stages]]
    name = "walk"
    arena.name = "anymal-walk"
    budget.success = 0.9
    budget.steps = 100_000_000

A stage ends by its budget. Keys that it does not name have the league's values.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from league.config.schema import ConfigError, Key, bare, literal, refuse
from league.config.sections import check_name

KEY = "stages"
OF_THE_LEAGUE = ("league", "seed", "deterministic", "engine", "workers", "storage", "after", KEY)
"""Settings that are the same in all stages."""


@dataclass(frozen=True)
class Stage:
    """A part of a curriculum: settings that override those of the league, as plain TOML values."""

    name: str
    settings: Mapping[str, Any]


def read(tables: Any) -> tuple[Stage, ...]:
    """Return the stages of a file. Raises ConfigError, with the key, for an invalid table of a stage."""
    if not isinstance(tables, Sequence) or not all(isinstance(table, Mapping) for table in tables):
        raise ConfigError((KEY,), f"{KEY}: expected a list of tables, each beginning with [[{KEY}]]")
    stages = []
    for i, table in enumerate(tables):
        name = table.get("name", "")
        if not isinstance(name, str) or not name:
            raise ConfigError((KEY, str(i), "name"), f"{KEY}[{i}]: a stage needs a name, in quotes")
        try:
            check_name(name)
        except ValueError as error:
            raise refuse((KEY, str(i), "name"), name, error) from None
        for key in OF_THE_LEAGUE:
            if key in table:
                raise ConfigError((KEY, str(i), key), f"{KEY}[{i}].{key}: is the same in all stages; set it above them")
        stages.append(Stage(name, {key: value for key, value in table.items() if key != "name"}))
    name, count = Counter(stage.name for stage in stages).most_common(1)[0] if stages else ("", 0)
    if count > 1:
        raise ConfigError((KEY,), f"{KEY}: {count} are called {name}; give each a name of its own")
    return tuple(stages)


def written(stages: Sequence[Stage]) -> str:
    """Write the stages as TOML that `read` reads back unchanged."""
    return "".join(
        f"\n[[{KEY}]]\nname = {literal(stage.name)}\n"
        + "".join(f"{'.'.join(map(bare, key))} = {literal(value)}\n" for key, value in _flat(stage.settings))
        for stage in stages
    )


def _flat(table: Mapping[str, Any], prefix: Key = ()) -> Iterator[tuple[Key, Any]]:
    for name, value in table.items():
        key = (*prefix, name)
        if isinstance(value, Mapping) and value:
            yield from _flat(value, key)
        else:
            yield key, value
