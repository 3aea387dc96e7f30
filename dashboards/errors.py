"""Errors of showing a match."""


class ViewerError(RuntimeError):
    """The match cannot be drawn here; the message is one line that says what is possible or what to type instead."""
