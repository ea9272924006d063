"""Training, evaluation and visualization of a run on the task NarrowPassage."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from matplotlib.image import imread
from PIL import Image
from safetensors.numpy import load_file

from guiderail.models.primitives import Demonstrations
from guiderail.tools.evaluation.evaluate import evaluate
from guiderail.tools.evaluation.subject import EpisodeSpec
from guiderail.tools.learning.run_folder import RunFolder, configure
from guiderail.tools.learning.trainer import run_training
from guiderail.tools.visualization import camera
from guiderail.tools.visualization.replay import tube
from guiderail_data.validate import validate_demonstrations

SETTINGS = {"net_arch": "32", "batch_size": 16, "gradient_steps": 1, "learning_starts": 40}


@pytest.fixture(scope="module")
def config():
    return configure("NarrowPassage", {"guidance": "skgrl"}, preset="tqc_fast", settings=SETTINGS, episodes=3, seed=1)


@pytest.fixture(scope="module")
def trained(config, tmp_path_factory):
    folder = RunFolder(tmp_path_factory.mktemp("run") / "run")
    run_training(folder, config)
    return folder


def test_training_satisfies_the_constraints_throughout(trained):
    rows = trained.episodes()
    assert (rows["success"] == 1).all()
    assert (rows["collisions"] == 0).all()
    assert rows[["max_commanded_violation", "max_measured_violation"]].to_numpy().max() <= 1e-9


def test_reward_terms_sum_to_the_return(trained):
    rows = trained.episodes()
    np.testing.assert_allclose(rows["return"], rows.filter(like="reward_").sum(axis=1), rtol=1e-9)


def test_run_resumes_bit_for_bit(trained, config, tmp_path):
    resumed = RunFolder(tmp_path / "run")
    run_training(resumed, replace(config, episodes=2))
    run_training(resumed, config, resume=True)
    first, second = (folder.episodes().drop(columns="wall_time") for folder in (trained, resumed))
    pd.testing.assert_frame_equal(first, second)
    a, b = (load_file(folder.path / "policy.safetensors") for folder in (trained, resumed))
    assert all(np.array_equal(a[key], b[key]) for key in a)


def test_evaluation_includes_the_demonstration_and_saves_the_episodes(trained, tmp_path):
    file = tmp_path / "saved.npz"
    result = evaluate(trained.path, episodes=2, baselines=("uniform_random",), save=file)
    assert result["demonstration_success_rate"] == 1.0
    assert result["max_commanded_violation"] <= 1e-9
    assert result["saved"] == 2
    assert Demonstrations.load(file).num_demonstrations == 2
    assert validate_demonstrations(file)["demonstrations"] == 2


@pytest.fixture(scope="module")
def recorded(trained):
    """Return an episode's row of metrics and video frames, fewer than usual, because encoding them takes seconds."""
    return camera._run(EpisodeSpec.of_policy(trained.path), camera.MAX_VIDEO_FRAMES // 8)


def test_image_has_the_format_of_its_ending(recorded, trained, tmp_path, monkeypatch):
    monkeypatch.setattr(camera, "_run", lambda *_: recorded)
    for ending, magic in ((".png", b"\x89PNG"), (".jpg", b"\xff\xd8\xff")):
        picture = tmp_path / f"film{ending}"
        row = camera.write_image(picture, EpisodeSpec.of_policy(trained.path))
        assert row["success"]
        assert picture.read_bytes().startswith(magic)
        image = imread(picture)
        assert image.shape[0] > 400
        assert image[..., :3].std() / image.max() > 0.05  # the image is not blank


@pytest.mark.parametrize("ending", [".webp", ".gif"])
def test_video_is_an_animation_in_real_time(ending, recorded, trained, tmp_path, monkeypatch):
    monkeypatch.setattr(camera, "_run", lambda *_: recorded)
    row = camera.write_video(tmp_path / f"video{ending}", EpisodeSpec.of_policy(trained.path))
    with Image.open(tmp_path / f"video{ending}") as video:
        assert video.n_frames > 10
        durations = []
        for frame in range(video.n_frames - 1):
            video.seek(frame)
            video.load()
            durations.append(video.info["duration"])
    assert abs(1e-3 * sum(durations) - 0.02 * row["steps"]) < 0.2 * 0.02 * row["steps"]


def test_tube_has_a_constant_radius():
    points = np.column_stack([np.linspace(0, 1, 31), np.sin(np.linspace(0, 3, 31)), np.zeros(31)])
    vertices, faces = tube(points, 0.01)
    centers = np.vstack([points[:-1:3], points[-1:]])  # the tube has a ring of vertices at every third point
    distance = np.linalg.norm(vertices.reshape(len(centers), -1, 3) - centers[:, None], axis=2)
    np.testing.assert_allclose(distance, 0.01, rtol=1e-9)
    assert faces.min() == 0
    assert faces.max() == len(vertices) - 1
