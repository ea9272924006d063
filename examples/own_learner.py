"""Write your own learner, here hill climbing: each episode tests a random change of the best linear policy so far."""

import numpy as np

import guiderail as gr
from guiderail.models.policy import FORMAT


@gr.register_learner("hill_climbing")
class HillClimbing(gr.Learner):
    def __init__(self, config, env, *, seed, **unused):
        self.space, self.rng = env.action_space, np.random.default_rng(seed)
        self.best = np.zeros((env.action_space.shape[0], env.observation_space.shape[0] + 1))
        self.highest, self.tried, self.score = -np.inf, self.best, 0.0

    def on_episode_start(self):
        self.tried, self.score = self.best + 0.3 * self.rng.standard_normal(self.best.shape), 0.0

    def act(self, observation):
        return np.tanh(self.tried @ np.append(observation, 1.0)).astype(np.float32)

    def on_step(self, transition):
        self.score += transition.reward

    def on_episode_end(self, row):
        if self.score > self.highest:
            self.best, self.highest = self.tried, self.score
        return {}

    def policy(self, description):
        limits = {"action_low": self.space.low.tolist(), "action_high": self.space.high.tolist()}
        layer = (self.best[:, :-1].astype(np.float32), self.best[:, -1].astype(np.float32))
        return gr.Policy([layer], {"format": FORMAT, **limits, **description})

    def state(self):
        return {"best": self.best}, {"highest": self.highest, "random": self.rng.bit_generator.state}

    def restore(self, arrays, values):
        self.best, self.highest, self.rng.bit_generator.state = arrays["best"], values["highest"], values["random"]

    def has_diverged(self):
        return not np.isfinite(self.best).all()


if __name__ == "__main__":
    run = gr.train("NarrowPassage", "kgrl", algorithm="hill_climbing", episodes=3, out="runs/hill", pictures=False)
    print("returns:", run.episodes["return"].round(1).tolist())
