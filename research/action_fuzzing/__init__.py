"""Fuzzing of tasks with random and extreme actions, `python -m research.action_fuzzing TASK`."""
