"""The colours of teams in a scene, in a module of their own, because drawing a recording must not load physics."""

TEAM_COLOURS = (
    (0.16, 0.42, 0.90, 1.0), (0.88, 0.22, 0.20, 1.0), (0.21, 0.73, 0.44, 1.0), (0.93, 0.88, 0.45, 1.0),
    (0.39, 0.07, 0.50, 1.0), (0.94, 0.53, 0.00, 1.0), (0.60, 0.70, 0.70, 1.0), (0.91, 1.00, 1.00, 1.0),
)  # fmt: skip
"""Red, green, blue and opacity, 0 to 1, by the team's number: blue, red, green, yellow, purple, orange, grey, white.

People with normal vision, protanopia, deuteranopia or tritanopia can tell any two apart: they are 26 or more apart in
CIELAB. The first two are part of the hash under which matches of two teams are kept.
"""
