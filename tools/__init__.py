"""Applications: the `guiderail` command, training, evaluation and visualization."""
