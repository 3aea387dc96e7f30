"""Errors of learning. Imports nothing heavy, because processes that only schedule work handle these errors too."""


class Diverged(Exception):  # noqa: N818  (a sentence reads better: "blue has diverged")
    """Numbers of a learner are no longer finite. The message names them; the learner must return to an older state."""
