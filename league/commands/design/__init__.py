"""Commands that prepare a league: arenas, robots, presets and configuration files."""
