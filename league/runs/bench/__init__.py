"""Robot League Bench: frozen tasks, public references, and entries that are measured against them."""
