"""Policies on a robot: deployment, evaluation, training, simulated driver and safety monitor."""
