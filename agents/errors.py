"""What can go wrong in learning. Loads nothing heavy: whoever hands out the work must know it too."""


class Diverged(Exception):  # noqa: N818  (a sentence reads better: "blue has diverged")
    """Numbers of a learner are no longer finite. The message names them; the learner must go back to what it was."""
