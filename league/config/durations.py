"""Spans of time as people write them: `90`, `"90s"`, `"5m"`, `"1h30m"`."""

import math
import re

UNITS = {"d": 86400.0, "h": 3600.0, "m": 60.0, "s": 1.0}
"""Seconds in each unit, longest first; a duration names its units in this order."""

_NUMBER = r"(\d+(?:\.\d+)?)"
_PATTERN = re.compile("".join(rf"(?:{_NUMBER}{unit})?" for unit in UNITS))


def seconds(duration: float | str) -> float:
    """Return a duration in seconds: a number of seconds, its text, or text with units such as `"1h30m"`.

    Raises:
        ValueError: the duration is negative, not finite, or not written in one of these ways.
    """
    if isinstance(duration, str):
        text = duration.strip().lower()
        parts = _PATTERN.fullmatch(text)
        if text and parts:
            return sum(float(part) * size for part, size in zip(parts.groups(), UNITS.values(), strict=True) if part)
        if re.fullmatch(_NUMBER, text):
            return float(text)
    elif not isinstance(duration, bool) and math.isfinite(duration) and duration >= 0:
        return float(duration)
    given = f'"{duration}"' if isinstance(duration, str) else str(duration)
    raise ValueError(
        f'{given} is not a duration: write 90, "90s", "5m", "1h30m" or "2d" (units in the order d, h, m, s)'
    )
