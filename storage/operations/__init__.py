"""The operations of a store, by subject: leadership, jobs, players and results."""
