"""Data-parallel training: a turn spread over processes that a worker starts itself, or that others have started."""
