"""Commands that move, check and thin what a store holds."""
