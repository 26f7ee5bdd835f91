"""The built documentation: strict, complete, and nothing in it is loaded from another host."""

import importlib.util
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import chromium
import fleetkit
import pytest

ROOT = Path(__file__).parent.parent
NEEDED = ("mkdocs", "material", "mkdocstrings", "latex2mathml")
pytestmark = [
    pytest.mark.docs,
    pytest.mark.skipif(
        not all(importlib.util.find_spec(name) for name in NEEDED), reason="needs the extra docs"
    ),
]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def address(site: Path) -> Iterator[str]:
    with fleetkit.served(site) as address:
        yield address


def test_no_page_loads_anything_from_another_host(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > 30
    loaded = re.compile(
        r'(?:<(?:script|img|iframe|source|video)[^>]*?\ssrc=|<link[^>]*?rel="(?!canonical|edit)[^"]*"[^>]*?href=)'
        r'"?((?:https?:)?//[^"\s>]+)'
    )
    styles = re.compile(r"(?:@import|url\()\s*['\"]?((?:https?:)?//[^'\")]+)")
    found = {
        f"{path.relative_to(site)}: {url}"
        for path in [*pages, *site.rglob("*.css")]
        for url in (loaded if path.suffix == ".html" else styles).findall(path.read_text(encoding="utf-8"))
    }
    assert not found


def test_formulas_diagrams_and_the_help_of_commands_are_rendered(site):
    estimation = (site / "explanation" / "estimation.html").read_text(encoding="utf-8")
    assert "<math" in estimation
    assert "arithmatex" not in estimation
    assert '<svg role="img"' in (site / "architecture.html").read_text(encoding="utf-8")
    assert "usage: drivelink diagnose" in (site / "reference" / "commands.html").read_text(encoding="utf-8")


@pytest.mark.skipif(chromium.EXECUTABLE is None, reason="needs Chromium")
def test_in_a_browser_nothing_is_asked_of_another_host_and_a_phone_shows_whole_pages_and_searches(
    site, address, tmp_path
):
    pages = ["index.html", "architecture.html", "explanation/estimation.html", "reference/commands.html"]
    with chromium.Chromium(tmp_path / "profile") as browser:
        browser.resize(390, 844)
        for page in pages:
            browser.open(f"{address}/{page}")
            hosts = browser.evaluate(
                "performance.getEntriesByType('resource').map(entry => new URL(entry.name).origin)"
            )
            assert set(hosts) <= {address}, page
            assert browser.evaluate("document.documentElement.scrollWidth") <= 390, page
            cut = "[...document.querySelectorAll('math, pre code')].filter(e => e.scrollWidth > innerWidth).length"
            assert browser.evaluate(cut) == 0, page
        browser.open(f"{(site / 'index.html').as_uri()}?q=covariance")  # the search works without a server
        assert browser.wait_for("document.querySelectorAll('.md-search-result__item').length")
