"""The pages as a site: built without warnings, no link leads nowhere, and a browser shows them at two widths."""

import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

import spikeloom

pytest.importorskip("sphinx_book_theme", reason="the extra spikeloom[site] is not installed")
pytest.importorskip("myst_nb", reason="the extra spikeloom[site] is not installed")

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """Built as the page says; a warning would be an error."""
    folder = tmp_path_factory.mktemp("site") / "html"
    words = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-c", "docs", ".", folder]
    built = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return folder


class Page(HTMLParser):
    """What a page has, and what it leads to or loads."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.names, self.leads, self.loads = set(), [], []
        self.feed(file.read_text("utf-8"))

    def handle_starttag(self, tag, attrs):
        known = dict(attrs)
        self.names.add(known.get("id"))
        if tag == "a" and known.get("href"):
            self.leads.append(known["href"])
        elif tag in ("img", "script", "link"):
            self.loads += [known[name] for name in ("src", "href") if known.get(name)]


@pytest.fixture(scope="module")
def pages(site) -> dict[Path, Page]:
    return {file: Page(file) for file in site.rglob("*.html") if "_static" not in file.parts}


def test_links_lead_somewhere_and_nothing_is_loaded_from_elsewhere(site, pages):
    seen = 0
    for file, page in pages.items():
        for link in (*page.leads, *page.loads):
            if "://" in link:
                assert link in page.leads, link
                continue
            path, _, name = link.partition("#")
            there = (file.parent / unquote(path.partition("?")[0])).resolve() if path else file
            assert there.is_file(), f"{file.relative_to(site)}: {link}"
            if name and there in pages:
                assert unquote(name) in pages[there].names, f"{file.relative_to(site)}: {link}"
            seen += 1
    assert seen > 1000


def test_every_page_picture_name_and_command_is_there(site, pages):
    for source in (ROOT / "docs").glob("*.md"):
        shown = pages[site / "docs" / f"{source.stem}.html"]
        pictures = re.findall(r"!\[.*\]\(.*/(.+\.png)\)", source.read_text("utf-8"))
        assert {f"../_images/{name}" for name in pictures} <= set(shown.loads)
    names = pages[site / "docs" / "python.html"].names
    assert {f"spikeloom.{name}" for name in spikeloom.__all__} - {"spikeloom.__version__"} <= names
    assert {"compile", "verify", "estimate", "watch"} <= pages[site / "docs" / "commands.html"].names


def browsed(page: Path, script: str, *, width: int, asked: str = "") -> str:
    """What a script returns two seconds after a page is loaded."""
    command = os.environ.get("CHROMIUM") or shutil.which("chromium")
    if not command:
        pytest.skip("no browser on this machine (install Debian's package chromium, or set CHROMIUM)")
    copy = page.with_name(f"{page.stem}-browsed.html")
    after = (
        f'<script>addEventListener("load", () => {{ document.title = (() => {{ {script} }})(); }})</script>'
    )
    copy.write_text(page.read_text("utf-8").replace("</body>", f"{after}</body>"), "utf-8")
    words = [command, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
    words += [f"--user-data-dir={page.parent / 'profile'}", f"--window-size={width},900"]
    words += ["--virtual-time-budget=5000", "--dump-dom", copy.as_uri() + asked]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    copy.unlink()
    title = re.search("<title>(.*?)</title>", done.stdout, re.DOTALL)
    assert title is not None
    return title[1]


@pytest.mark.parametrize("width", [500, 1300])
@pytest.mark.parametrize("name", ["README", "docs/compile", "docs/python", "examples/touch"])
def test_a_browser_shows_pages_and_pictures_within_its_width(site, name, width):
    script = """
    const missing = [...document.images].filter((image) => !image.naturalWidth).length;
    const menu = document.querySelector(".bd-sidebar-primary").getBoundingClientRect();
    return [missing, document.documentElement.scrollWidth <= innerWidth, menu.right > 0].join();"""
    wide = str(width > 1000).lower()
    assert browsed(site / f"{name}.html", script, width=width) == f"0,true,{wide}"


def test_the_search_finds_pages(site):
    script = 'return [...document.querySelectorAll("#search-results a")].map((each) => each.textContent).join("; ")'
    found = browsed(site / "search.html", script, width=1300, asked="?q=overflow")
    assert "Compile: from a trained network to a netlist" in found
