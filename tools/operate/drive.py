"""Pour yourself: the diagram that a policy learns on, driven through a browser.

    python -m guiderail.tools.operate.drive

Open the address that is printed. A gamepad's left stick moves the thermos, its right stick lifts it; without one, the
sliders do, or the keys A and D, S and W, F and R. Ctrl-C ends.
"""

from collections.abc import Callable

import numpy as np

from guiderail.diagrams.tasks.pouring import make_env
from guiderail.systems.meshcat_device import MeshcatDevice

AXES = ((0, 1.0), (1, -1.0), (3, -1.0))
KEYS = (("KeyA", "KeyD"), ("KeyS", "KeyW"), ("KeyF", "KeyR"))


def drive(env, driver: Callable[[np.ndarray], np.ndarray], episodes: int) -> list[str]:
    """Runs episodes with whoever drives; returns how they ended. A policy is a driver, and so is a person's device."""
    endings = []
    for _ in range(episodes):
        observation, info = env.reset()
        over = False
        while not over:
            observation, _, terminated, truncated, info = env.step(driver(observation))
            env.render()
            over = terminated or truncated
        endings.append(info["termination"])
    return endings


def main() -> None:
    """Until somebody has had enough."""
    env = make_env(render_mode="human")
    meshcat = env.task.meshcat
    assert meshcat is not None
    device = MeshcatDevice(meshcat, AXES, KEYS, env.task.control_period)
    print(f"drive at {meshcat.web_url()}")
    while True:
        print(*drive(env, lambda observation: device.read(), episodes=1))


if __name__ == "__main__":
    main()
