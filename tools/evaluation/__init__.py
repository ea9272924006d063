"""Evaluation of policies: rollouts, metrics and baselines."""
