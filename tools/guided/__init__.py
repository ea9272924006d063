"""Guidance around environments that were made elsewhere: `GuidedEnv`, which needs neither Drake nor PyTorch."""
