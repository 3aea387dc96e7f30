"""Former name of `arenas.contract.shape_checks`, kept for one release."""

from arenas.contract.shape_checks import *  # noqa: F403
