"""Policies in other arenas, and as the start or the skills of other players."""
