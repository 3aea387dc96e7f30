"""Blobs: bytes named by their digest in a folder or a bucket, and the formats of what they hold."""
