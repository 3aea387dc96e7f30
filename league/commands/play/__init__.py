"""Commands that play matches on request."""
