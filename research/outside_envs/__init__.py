"""Guidance around environments of other packages, metaworld and robosuite; `make outside` installs them."""
