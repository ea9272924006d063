"""Teleoperation in the browser, with or without a recording, and human supervision of training runs."""
