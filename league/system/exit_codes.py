"""The exit codes of `league`. `docs/deploy.md` has a table of them, and systemd units depend on them."""

DONE = 0
NO = 1
"""The answer of a command is no, or the program has a bug."""
BAD_INPUT = 2
"""The request cannot be carried out until the user changes it."""
PASSING = 75
"""Temporary failure, EX_TEMPFAIL of sysexits.h: no access to the store, another leader, or a killed process."""
UNFIT = 78
"""This host cannot do a worker's jobs although other hosts can: a person must repair it."""

MEANINGS = {
    "0": "done",
    "1": "the answer is no (verify, check, gate), or a fault of this program",
    "2": "what was asked for cannot be: one line says why",
    "3": "undecided (gate)",
    "75": "trouble that may pass, such as a store that is away: try again",
    "78": "a worker's host cannot do its jobs",
    "130": "Ctrl-C",
}


def of(error: BaseException) -> int:
    """Return the exit code of an expected error, one with an explanation in its message."""
    return PASSING if getattr(error, "transient", False) else BAD_INPUT
