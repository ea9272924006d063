"""Evaluation of policies: rollouts, metrics, baselines and robustness."""
