"""Fixtures of the tests of robots."""

import pytest


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a text to a file of a name, and returns its path."""

    def written(text, name="bot.xml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return written
