"""Summary of the thesis's result in each figure and table, which is printed with the reproduced result."""

THESIS = {
    "2.2": "three states, Translational, Tilt and Pour; three inputs",
    "3.4": "a simulated iiwa with a thermos, a mug on a table, two balls of 4 cm",
    "3.5": "SAC, 10 sessions: RL-Sparse does not learn within 1400 episodes, RL-Shaped converges within 1200 with many "
    "spills and collisions, RL-SCT-Sparse within 600 and RL-SCT-Shaped within 250, both without collisions",
    "3.6": "TQC, 10 sessions: RL-Sparse does not learn within 1400 episodes, RL-Shaped converges within 700 "
    "with many spills and collisions, RL-SCT-Sparse within 1000 and RL-SCT-Shaped within 250, both without collisions",
    "3.7": "RL-SCT-Shaped with SAC, a real robot, 5 sessions: a success rate of 1 within 65 episodes, 9700 time steps, "
    "on average; no spills and no collisions",
    "3.8": "no session of RL-Sparse converged within 1400 episodes; with SAC a median of 12 % of RL-Sparse's and 20 % "
    "of RL-Shaped's episodes involved a collision; with TQC, 2 to 5 % involved spills and collisions; with templates "
    "hardly any",
    "3.10": "a real robot, 5 sessions: 100 % success in 70 episodes, 9820 time steps, with and without the cost of "
    "force, which lowers the force while learning significantly and changes neither the time until 100 % nor the steps "
    "of an episode significantly; without it, failures after episode 70; no collisions",
    "3.11": "both rewards converge in about 70 episodes",
    "4.1": "a real robot: the motion learned from the demonstrations alone does not solve the task",
    "4.2": "one action at 3.2 s changes the motion nearby, smoothly and inside the bounds; random actions change it "
    "more where the demonstrations' variance is larger",
    "4.3": "a passage, an obstacle in the robot's way, a restricted zone beyond x = 0.6",
    "4.4": "residual RL explores in all directions alike, KGRL hardly in the passage",
    "4.5": "KGRL succeeds from the first episode on; both kinds of residual RL are unstable and often get stuck",
    "4.6": "KGRL: no collision and no violation; residual RL: many of both; safe residual RL: none",
    "4.7": "the obstacle is avoided within 30 episodes",
    "4.8": "a real robot: a success rate of 1 in 45 episodes on average, with less force and shorter episodes",
    "5.1": "as figure 4.1",
    "5.2": "KGRL's motion jumps from window to window, sKGRL's is smooth",
    "5.3": "as figure 4.3",
    "5.4": "after a push the robot returns faster where the demonstrations' variance is smaller, and the replanned "
    "motion respects the constraint",
    "5.5": "one motion of KGRL is erratic, five of sKGRL are smooth",
    "5.6": "sKGRL has the higher return, by a lower cost of actions, and takes longer to avoid the obstacle",
    "5.7": "a real robot: an unsuccessful episode while learning, and a successful one after it",
    "5.8": "a real robot: KGRL's positions jump, sKGRL's do not",
    "5.9": "a real robot: a success rate of 1 in 42 episodes (KGRL) and 44 (sKGRL); after convergence KGRL's return is "
    "higher, because sKGRL lowers forces and steps less",
    "5.10": "a real robot: sKGRL's mean jerk in the first ten episodes is orders of magnitude below KGRL's, in "
    "translation and rotation",
    "table 3.2": "learning rates, discounts and batches of SAC and TQC on two robots",
    "table 3.3": "prior knowledge about pouring, as a reward and as a template",
    "table 4.1": "TQC in simulation and on the real robot",
}

# Settings by preset. As in the presets, gamma is per action in table 3.2 and per control step in table 4.1.
TABLE_3_2 = {
    "table_3_2_iiwa": {
        "learning_rate": 8e-4, "buffer_size": 1_000_000, "gamma": 0.95, "tau": 0.02, "train_freq": 8,
        "gradient_steps": 8, "learning_starts": 1000, "batch_size": 256,
    },
    "table_3_2_sara": {
        "learning_rate": 1e-3, "buffer_size": 1_000_000, "gamma": 0.98, "tau": 0.02, "train_freq": 8,
        "gradient_steps": 8, "learning_starts": 1000, "batch_size": 256,
    },
}  # fmt: skip
TABLE_4_1 = {
    "table_4_1_simulation": {
        "learning_rate": 1e-3, "tau": 0.02, "gamma": 0.99, "train_freq": 8, "gradient_steps": 8,
        "ent_coef": "auto", "net_arch": (256, 256),
    },
    "table_4_1_robot": {
        "learning_rate": 1e-3, "tau": 0.01, "gamma": 0.995, "train_freq": 8, "gradient_steps": 8,
        "ent_coef": "auto_0.1", "net_arch": (256, 256),
    },
}  # fmt: skip
