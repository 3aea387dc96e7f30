"""The stages of a curriculum: tables [[stages]], each a name and settings that override those of the league.

    [[stages]]
    name = "walk"
    arena.name = "anymal-walk"
    budget.success = 0.9
    budget.steps = 100_000_000

A stage ends by its budget. Keys that it does not name have the league's values. On a command line
`--stages.walk.learner.lr 1e-4` sets a key of one stage, of a preset too.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from league.config.flags import Given
from league.config.schema import ConfigError, Key, bare, dotted, literal, refuse
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


def apart(given: Given) -> tuple[dict[Key, str], dict[str, dict[Key, str]]]:
    """Return the flags of the league, and those of its stages by their names. Raises ConfigError for one without a key
    of a stage, or with one that all stages share.
    """
    own = {key: text for key, text in given.items() if key[0] != KEY}
    of_stages: dict[str, dict[Key, str]] = {}
    for key, text in given.items():
        if key[0] != KEY:
            continue
        if len(key) < 3:
            raise ConfigError(key, f"--{dotted(key)}: name a stage and a key of it: --{KEY}.match.learner.lr 1e-4")
        if key[2] == KEY:
            raise ConfigError(key, f"--{dotted(key)}: a stage has no stages of its own")
        if key[2] in OF_THE_LEAGUE:
            raise ConfigError(key, f"--{dotted(key)}: is the same in all stages; give --{dotted(key[2:])}")
        of_stages.setdefault(key[1], {})[key[2:]] = text
    return own, of_stages


def find(flag: str, stages: Sequence[Stage]) -> Stage | None:
    """Return the stage of that name, where a flag has `_` for `-`; None if there is none."""
    return next((each for each in stages if each.name.replace("-", "_") == flag), None)


def as_given(key: Key, stages: Sequence[Stage]) -> Key:
    """Return a key of a stage, which has its number, as a flag gives it: with its name. Other keys stay."""
    if key[:1] != (KEY,) or not key[1:2] or not key[1].isdecimal():
        return key
    return (KEY, stages[int(key[1])].name.replace("-", "_"), *key[2:])


def number_of(flag: str, stages: Sequence[Stage]) -> int:
    """Return the number of a flag's stage. Raises ConfigError, with the names that there are."""
    found = find(flag, stages)
    if found is not None:
        return stages.index(found)
    there = f"there are {', '.join(each.name for each in stages)}" if stages else "this league has no stages"
    raise ConfigError((KEY, flag), f"--{KEY}.{flag}: no stage has that name; {there}")


def refused(own: Stage, error: ConfigError) -> ConfigError:
    """Return the error of a flag of a stage: it names the stage, and options as they are given for it."""
    message = error.message
    if message.startswith("unknown option"):
        message = re.sub("--(?!help)", f"--{KEY}.{own.name}.", message)
    return ConfigError((KEY, own.name), f"stage {own.name}: {message}")


def of_stage(error: ConfigError, number: int, stages: Sequence[Stage]) -> ConfigError:
    """Return an error of a stage's settings, which names the stage; its key is the stage's where that has one."""
    own = stages[number]
    given = any(all(a == b for a, b in zip(key, error.key, strict=False)) for key, _ in _flat(own.settings))
    key = (KEY, str(number), *error.key) if given else error.key
    return ConfigError(key, f"stage {own.name}: {error.message}")


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
