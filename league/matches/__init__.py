"""Matches: evaluation of pairs of snapshots, recordings of episodes, ad-hoc matches."""
