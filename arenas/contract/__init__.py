"""The contract of arenas: the checks that `league check` and the tests run, and environments of other libraries."""
