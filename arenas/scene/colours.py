"""The colours of teams in a scene, in a module of their own, because drawing a recording must not load physics."""

TEAM_COLOURS = ((0.16, 0.42, 0.90, 1.0), (0.88, 0.22, 0.20, 1.0), (0.16, 0.66, 0.36, 1.0), (0.90, 0.66, 0.12, 1.0))
"""Red, green, blue and opacity, 0 to 1, by the team's number; a fifth team has the first team's colour."""
