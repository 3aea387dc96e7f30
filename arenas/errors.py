"""What can be wrong with an arena or an engine, each told in one line."""


class ArenaError(Exception):
    """A wrong arena name, setting or contract; the message is one line for the user."""


class EngineError(Exception):
    """An engine that does not exist or cannot run here; the message is one line for the user."""
