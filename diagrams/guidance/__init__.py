"""Guidance: what stands between a policy's action and the pose that a robot is commanded."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
