"""Commands that show matches and curves."""
