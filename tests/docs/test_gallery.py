"""Animations of the gallery page: complete, small and up to date."""

import json
import re
import sys
from pathlib import Path

import pytest
from PIL import Image

DOCS = Path(__file__).parents[2] / "docs"
NAMES = re.findall(r"\]\(pictures/(\w+)\.webp\)", (DOCS / "gallery.md").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def gallery():
    """Return the module in `docs/` that renders the gallery."""
    sys.path.insert(0, str(DOCS))
    try:
        import make_gallery
    finally:
        sys.path.remove(str(DOCS))
    return make_gallery


def test_gallery_page_has_every_animation(gallery):
    assert sorted(NAMES) == sorted(gallery.PICTURES)


@pytest.mark.parametrize("name", NAMES)
def test_animation_is_small_and_moves(gallery, name):
    path = gallery.FOLDER / f"{name}.webp"
    assert path.is_file(), f"{path} is missing: make gallery"
    assert path.stat().st_size < 250_000
    with Image.open(path) as picture:
        assert picture.n_frames > gallery.FRAMES // 2
        first, last = (picture.seek(frame) or picture.convert("RGB") for frame in (0, picture.n_frames - 1))
    assert first.tobytes() != last.tobytes()


def test_animations_together_are_small(gallery):
    assert sum(path.stat().st_size for path in gallery.FOLDER.glob("*.webp")) < 2_500_000


def test_endings_are_stored_for_every_panel(gallery):
    endings = json.loads((gallery.FOLDER / "gallery.json").read_text(encoding="utf-8"))
    for name, (panels, _, _) in gallery.PICTURES.items():
        assert list(endings[name]) == [panel.title for panel in panels()], f"{name} is stale: make gallery"


def test_readme_commands_train_what_the_picture_shows(gallery):
    commands = gallery.readme_commands()
    assert {f"{key}={value}" for key, value in gallery.ON_ARM.items() if key != "guidance"} <= {*commands["train"]}
    assert commands["train"][1] == "BncConnector"
    assert commands["train"][commands["train"].index("--out") + 1] == commands["visualize"][1]
    assert (gallery.FOLDER / "readme.jpg").is_file()


def test_captions_state_the_stored_endings(gallery):
    endings = json.loads((gallery.FOLDER / "gallery.json").read_text(encoding="utf-8"))
    for page in (DOCS.parent / "README.md", DOCS / "index.md", DOCS / "gallery.md", DOCS / "start.md"):
        captions = re.findall(r"!\[([^\]]*)\]\([\w/]*pictures/(\w+)\.(?:webp|jpg)\)", page.read_text(encoding="utf-8"))
        assert captions, page.name
        for caption, name in captions:
            expected = "; ".join(f"{title}: {ending}" for title, ending in endings[name].items())
            assert caption == expected, f"{page.name}, {name}: {expected}"


def test_index_has_the_commands_of_the_readme():
    (commands,) = re.findall(r"```sh\n(pip install.*?)```", (DOCS / "index.md").read_text("utf-8"), re.DOTALL)
    assert commands in (DOCS.parent / "README.md").read_text("utf-8")


def test_endings_in_the_passage_are_up_to_date(gallery):
    endings = json.loads((gallery.FOLDER / "gallery.json").read_text(encoding="utf-8"))
    name = "passage_constraint"
    panels, size, steps_per_frame = gallery.PICTURES[name]
    for panel in panels():
        gallery.run_panel(panel, size, steps_per_frame)
        assert panel.ending() == endings[name][panel.title], f"{name} is stale: make gallery"
