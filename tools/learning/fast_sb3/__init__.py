"""Learners of Stable-Baselines3 with batched networks and hand-written gradients."""
