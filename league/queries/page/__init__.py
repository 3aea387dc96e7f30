"""The page of a league: an overview, and sections with figures and tables."""
