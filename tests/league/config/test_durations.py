import math

import pytest

from league.config.durations import seconds


@pytest.mark.parametrize(
    ("duration", "expected"),
    [(90, 90), (0.5, 0.5), ("90", 90), ("1.5", 1.5), ("90s", 90), ("5m", 300), ("1h30m", 5400), (" 1D2h3m4S ", 93784)],
)
def test_a_duration_is_a_number_of_seconds_or_a_text_with_units(duration, expected):
    assert seconds(duration) == expected


@pytest.mark.parametrize("duration", ["", "5x", "m", "30m1h", "1h 30m", "-5s", "1e3", -1, math.inf, math.nan, True])
def test_anything_else_is_refused_with_what_was_given_and_what_is_possible(duration):
    with pytest.raises(ValueError, match=r'is not a duration: write 90, "90s", "5m"') as error:
        seconds(duration)
    assert str(duration) in str(error.value)
