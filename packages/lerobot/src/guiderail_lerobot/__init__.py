"""Base policies, chunks of actions and their guard, distillation, and a server of environments for LeRobot."""
