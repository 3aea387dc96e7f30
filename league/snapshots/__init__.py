"""Snapshots as bytes and files: codec, policy files, archives, warm starts, retention."""
