"""Queries: read-only views of a store for tables, pages and the Python interface."""
