"""Training turns: learners, matchups, rollouts and updates, and what a turn writes."""
