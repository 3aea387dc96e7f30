"""Causes of void worlds, as a bit mask that passes from an engine to the store. Loads nothing heavy."""

from collections.abc import Iterable, Iterator
from enum import IntFlag

METRIC_PREFIX = "void."
"""Prefix of learning-curve metrics that count void decisions by cause, as in `void.pairs`."""


class Cause(IntFlag):
    """Reasons why a world is void. Several bits may be set at once."""

    PAIRS = 1
    """More pairs of geoms were near each other than the contact pool of all worlds holds."""
    CONTACTS = 2
    """There were more contacts than the pool holds."""
    ROWS = 4
    """A world needed more constraint rows than it has."""
    BUFFERS = 8
    """Another buffer of the engine was full."""
    NUMBERS = 16
    """Positions or velocities were not finite, or far too fast."""
    ACTIONS = 32
    """A policy's actions were not finite."""

    @property
    def key(self) -> str:
        """The lower-case name of a single cause, e.g. `pairs`."""
        return str(self.name).lower()

    @property
    def description(self) -> str:
        """A single cause as a short phrase."""
        return _WORDS[self]

    @property
    def setting(self) -> str:
        """The setting to raise against a single cause; empty if none helps."""
        return _SETTINGS.get(self, "")


_WORDS = {
    Cause.PAIRS: "pairs of geoms fill the contact pool",
    Cause.CONTACTS: "contacts fill the contact pool",
    Cause.ROWS: "constraint rows fill a world's buffer",
    Cause.BUFFERS: "another buffer of the engine is full",
    Cause.NUMBERS: "numbers are not finite",
    Cause.ACTIONS: "actions are not finite",
}
_SETTINGS = {
    Cause.PAIRS: "buffers.contacts", Cause.CONTACTS: "buffers.contacts", Cause.ROWS: "buffers.rows"
}  # fmt: skip


def causes_in(mask: int) -> Iterator[Cause]:
    """Yield the single causes of a mask, in a fixed order; unknown bits are left out."""
    return (cause for cause in Cause if mask & cause)


def describe_causes(causes: Iterable[Cause]) -> str:
    """Describe the causes and the settings to raise; empty if no cause is known."""
    known = list(causes)
    settings = dict.fromkeys(cause.setting for cause in known if cause.setting)
    parts = [", ".join(cause.description for cause in known)] if known else []
    parts += [f"raise {' and '.join(settings)}"] if settings else []
    return "; ".join(parts)
