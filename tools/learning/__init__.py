"""Training of policies: learners, configurations, run folders and checkpoints."""
