"""The error by which a turn ends for one of its players: its learning diverged, or its learner failed."""


class PlayerDiverged(Exception):  # noqa: N818  (a sentence: "the player diverged")
    """A player's learning diverged, or its learner failed; the store still holds its last good checkpoint."""

    def __init__(self, player: str, reason: object, what: str = "diverged"):
        super().__init__(f"{player} {what}: {reason}")
        self.player = player
