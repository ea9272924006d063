"""Teleoperation in the browser, with and without a recording, and supervision of a training."""
