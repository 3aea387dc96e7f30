"""The page of a league: document, figures, links to matches, server."""
