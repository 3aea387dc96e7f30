"""The games that come with the league, one package each."""
