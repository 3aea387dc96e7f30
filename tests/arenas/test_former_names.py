"""Former module names, which arenas of other people import, give the same objects as the present ones."""

from importlib import import_module

import pytest

FORMER = [
    ("arenas.options", "Timing", "arenas.arena_settings"),
    ("arenas.options", "Solver", "arenas.arena_settings"),
    ("arenas.options", "Where", "arenas.arena_settings"),
    ("arenas.options", "Settings", "arenas.arena"),
    ("arenas.about", "Part", "arenas.description"),
    ("arenas.about", "Legend", "arenas.description"),
    ("arenas.about", "Outline", "arenas.description"),
    ("arenas.about", "Seat", "arenas.description"),
    ("arenas.props", "bouncing", "arenas.scene.props"),
    ("arenas.hooks", "MARKERS", "arenas.contract.shape_checks"),
    ("arenas.physics", "Physics", "arenas.physics.engine"),
    ("arenas.physics", "VARIABLE", "arenas.physics.engine"),
]


@pytest.mark.parametrize(("module", "name", "now"), FORMER)
def test_a_former_name_gives_what_the_present_one_gives(module, name, now):
    assert getattr(import_module(module), name) is getattr(import_module(now), name)


@pytest.mark.parametrize("module", ["arenas.options", "arenas.physics"])
def test_a_name_that_never_was_is_an_attribute_error(module):
    with pytest.raises(AttributeError, match="has no attribute 'Nothing'"):
        import_module(module).Nothing  # noqa: B018
