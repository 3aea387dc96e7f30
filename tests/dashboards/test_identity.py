"""The colours of teams and players can be told apart by people with normal vision and by the colour-blind."""

from dataclasses import replace

import numpy as np
import pytest

from arenas.scene.colours import TEAM_COLOURS
from dashboards.identity import COLOURS, MatchPlayer, named_events
from tests.dashboards.cars import cars

# Severity 1 of Machado, Oliveira and Fernandes (2009), on linear red, green and blue.
VISIONS = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
WHITE = XYZ.sum(1)


def lab(srgb, vision):
    """CIELAB (n, 3) of sRGB colours (n, 3) from 0 to 1, as seen by a vision."""
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4) @ np.array(vision).T
    x, y, z = (np.clip(linear, 0, 1) @ XYZ.T / WHITE).T
    fx, fy, fz = (np.where(v > 216 / 24389, np.cbrt(v), (24389 / 27 * v + 16) / 116) for v in (x, y, z))
    return np.stack([116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)], axis=1)


def least_distance(colours, vision):
    seen = lab(np.array(colours, float), vision)
    far = np.linalg.norm(seen[:, None] - seen, axis=-1)
    return far[np.triu_indices(len(colours), 1)].min()


def test_the_scale_is_cielab():
    white, grey = lab(np.array([[1.0, 1.0, 1.0], [0.5, 0.5, 0.5]]), VISIONS["normal"])
    np.testing.assert_allclose([white, grey], [[100, 0, 0], [53.39, 0, 0]], atol=0.02)


@pytest.mark.parametrize("vision", VISIONS)
def test_eight_teams_have_colours_that_everybody_can_tell_apart(vision):
    assert len(TEAM_COLOURS) == 8
    assert least_distance([colour[:3] for colour in TEAM_COLOURS], VISIONS[vision]) > 26


@pytest.mark.parametrize("vision", VISIONS)
def test_eight_players_have_colours_that_everybody_can_tell_apart(vision):
    assert len(COLOURS) == 8
    assert least_distance(np.array(COLOURS) / 255, VISIONS[vision]) > 20


def test_events_name_the_player_of_a_side_and_not_the_side_that_another_has_the_colour_of():
    recording = replace(cars(), events=[(0, "friction: 1.5"), (3, "out: blue"), (4, "contact"), (9, "out: red")])
    swapped = [MatchPlayer("red@8", COLOURS[1]), MatchPlayer("blue@16", COLOURS[0])]
    assert named_events(recording, swapped) == [
        (0, "friction: 1.5"), (3, "out: red@8"), (4, "contact"), (9, "out: blue@16"),
    ]  # fmt: skip
    same = [MatchPlayer("red@8", COLOURS[1])] * 2
    assert [text for _, text in named_events(recording, same)[1::2]] == ["out: red@8 as blue", "out: red@8 as red"]
