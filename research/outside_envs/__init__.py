"""Guidance around environments of other packages: metaworld, in the environment of `make outside`."""
