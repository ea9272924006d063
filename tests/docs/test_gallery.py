"""The gallery shows what its command makes, small enough for a page, and is not older than the code."""

import json
import re
import sys
from pathlib import Path

import pytest
from PIL import Image

DOCS = Path(__file__).parents[2] / "docs"
SHOWN = re.findall(r"\]\(pictures/(\w+)\.webp\)", (DOCS / "gallery.md").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def gallery():
    """The module that makes it, which is no part of the package."""
    sys.path.insert(0, str(DOCS))
    try:
        import make_gallery
    finally:
        sys.path.remove(str(DOCS))
    return make_gallery


def test_the_page_shows_each_picture_that_the_command_makes_and_no_other(gallery):
    assert sorted(SHOWN) == sorted(gallery.PICTURES)


@pytest.mark.parametrize("name", SHOWN)
def test_a_picture_is_there_moves_and_is_small(gallery, name):
    path = gallery.FOLDER / f"{name}.webp"
    assert path.is_file(), f"{path} is missing: make gallery"
    assert path.stat().st_size < 250_000
    with Image.open(path) as picture:
        assert picture.n_frames > gallery.FRAMES // 2
        first, last = (picture.seek(n) or picture.convert("RGB") for n in (0, picture.n_frames - 1))
    assert first.tobytes() != last.tobytes()


def test_all_of_them_together_are_small(gallery):
    assert sum(path.stat().st_size for path in gallery.FOLDER.glob("*.webp")) < 2_500_000


def test_what_is_told_of_every_picture_is_there(gallery):
    told = json.loads((gallery.FOLDER / "gallery.json").read_text(encoding="utf-8"))
    for name, (panels, _, _) in gallery.PICTURES.items():
        assert list(told[name]) == [panel.title for panel in panels()], f"{name} is stale: make gallery"


def test_pictures_of_the_passage_show_what_the_code_does_today(gallery):
    told = json.loads((gallery.FOLDER / "gallery.json").read_text(encoding="utf-8"))
    name = "passage_constraint"
    panels, size, every = gallery.PICTURES[name]
    for panel in panels():
        gallery.run_panel(panel, size, every)
        assert panel.ending() == told[name][panel.title], f"{name} is stale: make gallery"
