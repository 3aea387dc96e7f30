"""Snapshots as bytes and files: codec, policy files, archives, retention; their transfer to other leagues."""
