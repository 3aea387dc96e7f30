"""Commands about several leagues: list, sweep, compare."""
