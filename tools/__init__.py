"""Applications: the `guiderail` command, training, evaluation, studies, datasets and operation of robots."""
