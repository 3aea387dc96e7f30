"""Former name of `arenas.description`, kept for one release."""

from arenas.description import *  # noqa: F403
