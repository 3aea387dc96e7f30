"""Errors of arenas and engines, each with a one-line message."""


class ArenaError(Exception):
    """A wrong arena name, setting or contract; the message is one line for the user."""


class EngineError(Exception):
    """An engine that does not exist or cannot run here; the message is one line for the user."""
