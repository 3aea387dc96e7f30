"""Former name of `arenas.arena_settings`, kept for one release."""

from typing import Any

from arenas.arena_settings import *  # noqa: F403


def __getattr__(name: str) -> Any:
    if name == "Settings":  # loads jax, which reading settings must not
        from arenas.arena import Settings

        return Settings
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
