"""Learning from replay: soft actor-critic for teams, its critics, its replay buffer and the scale of its rewards.

`agents.off_policy.sac.SacLearner` has the five methods of `agents.learner.interface.Learner`, and meets the league
through them alone, as a class of a user does.
"""
