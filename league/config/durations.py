"""Durations as people write them: `90`, `"90s"`, `"5m"`, `"1h30m"`."""

import math
import re

UNITS = {"d": 86400.0, "h": 3600.0, "m": 60.0, "s": 1.0}
"""Seconds in each unit, longest first; a duration names its units in this order."""

LONGEST = 100 * 366 * UNITS["d"]
"""The longest duration accepted, in seconds: a century."""

_NUMBER = r"([0-9]+(?:\.[0-9]+)?)"
_PATTERN = re.compile("".join(rf"(?:{_NUMBER}{unit})?" for unit in UNITS))


def seconds(duration: float | str) -> float:
    """Return a duration in seconds: a number of seconds, its text, or text with units such as `"1h30m"`.

    Raises:
        ValueError: the duration is negative, not finite, beyond a century, or not written in one of these ways.
    """
    given = f'"{duration}"' if isinstance(duration, str) else str(duration)
    given = given if len(given) <= 80 else f"{given[:60]} ..."
    found = _seconds(duration)
    if found is not None and found > LONGEST:
        raise ValueError(f"{given} is longer than a century")
    if found is not None:
        return found
    raise ValueError(
        f'{given} is not a duration: write 90, "90s", "5m", "1h30m" or "2d" (units in the order d, h, m, s)'
    )


def check_duration(value: float | str) -> None:
    """Raise ValueError unless `value` is a duration."""
    seconds(value)


def _seconds(duration: float | str) -> float | None:
    """Return a duration in seconds, infinite where it overflows a float; None if `duration` is not a duration."""
    if not isinstance(duration, str):
        fits = not isinstance(duration, bool) and math.isfinite(duration) and duration >= 0
        return float(duration) if fits else None
    text = duration.strip().lower()
    if text and (parts := _PATTERN.fullmatch(text)):
        return sum(float(part) * size for part, size in zip(parts.groups(), UNITS.values(), strict=True) if part)
    return float(text) if re.fullmatch(_NUMBER, text) else None
