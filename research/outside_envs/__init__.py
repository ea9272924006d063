"""Guidance around environments of other packages: metaworld and robosuite, in the environment of `make outside`."""
