"""Tag: pucks, each a team of its own, of which one is "it". Settings alone; nothing here loads jax."""

from arenas.games.tag.settings import ARENAS, TagReward, TagRules, TagSettings

__all__ = ["ARENAS", "TagReward", "TagRules", "TagSettings"]
