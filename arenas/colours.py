"""The colours of teams in a scene, alone, so that whoever draws a recording knows them without loading physics."""

TEAM_COLOURS = ((0.16, 0.42, 0.90, 1.0), (0.88, 0.22, 0.20, 1.0), (0.16, 0.66, 0.36, 1.0), (0.90, 0.66, 0.12, 1.0))
"""Red, green, blue and opacity, 0 to 1, by the team's number; a fifth team has those of the first."""
