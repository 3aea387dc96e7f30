"""Robot League: self-play leagues for teams of robots."""
