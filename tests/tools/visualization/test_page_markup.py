"""Names from data are text in generated pages, never markup."""

from pathlib import Path

import pytest

import guiderail
import guiderail_studies

ROOTS = [Path(package.__file__).parent for package in (guiderail, guiderail_studies)]
PAGES = [page for root in ROOTS for page in (*root.rglob("*.html"), *root.glob("tools/**/*.html"))]


@pytest.mark.parametrize("page", sorted(set(PAGES)), ids=lambda page: page.name)
def test_page_inserts_no_markup_from_a_script(page):
    text = page.read_text(encoding="utf-8")
    assert not [name for name in ("innerHTML", "outerHTML", "insertAdjacentHTML", "document.write") if name in text]


def test_all_pages_are_found():
    assert {"replay.html", "report.html"} <= {page.name for page in PAGES}
