"""Write your own learner, here hill climbing: each episode tests a random change of the best linear policy so far."""

import numpy as np

import guiderail as gr


@gr.register_learner("hill_climbing")
class HillClimbing(gr.Learner):
    stored = ("best", "highest", "rng")

    def __init__(self, config, env, *, seed, **unused):
        self.best = np.zeros((env.action_space.shape[0], env.observation_space.shape[0] + 1))
        self.highest, self.rng = -np.inf, np.random.default_rng(seed)

    def on_episode_start(self):
        self.tried, self.score = self.best + 0.3 * self.rng.standard_normal(self.best.shape), 0.0

    def act(self, observation):
        return np.tanh(self.tried @ np.append(observation, 1.0)).astype(np.float32)

    def on_step(self, transition):
        self.score += transition.reward

    def on_episode_end(self, row):
        if self.score > self.highest:
            self.best, self.highest = self.tried, self.score

    def policy(self, description):
        return gr.Policy([(self.best[:, :-1], self.best[:, -1])], description)


if __name__ == "__main__":
    run = gr.train("NarrowPassage", "kgrl", algorithm="hill_climbing", episodes=3, out="runs/hill", pictures=False)
    print("returns:", run.episodes["return"].round(1).tolist())
