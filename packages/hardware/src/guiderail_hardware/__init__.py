"""guiderail on robots: drivers, safety, training on a robot and teleoperation."""
