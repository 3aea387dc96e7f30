"""Former name of `arenas.scene.props`, kept for one release."""

from arenas.scene.props import *  # noqa: F403
