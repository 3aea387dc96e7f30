"""The database: where it is, how it is opened, its schema, and how its rows become records."""
