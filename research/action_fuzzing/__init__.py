"""Fuzzing of tasks with actions that no trained policy sends, `python -m research.action_fuzzing TASK`."""
