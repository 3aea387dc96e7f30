"""Arenas behind the interfaces of other libraries: PettingZoo and Gymnasium. `arenas.pettingzoo`, `arenas.vector` and
`arenas.single` open them.
"""
