"""Guidance for environments of other packages: `GuidedEnv`, which needs neither Drake nor PyTorch."""
