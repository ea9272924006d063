"""What a person runs: the `guiderail` command, training, replay, recording, studies and benchmarks."""
