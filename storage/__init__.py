"""Rows, blobs and recordings: what a league knows, kept so that no crash loses it."""
