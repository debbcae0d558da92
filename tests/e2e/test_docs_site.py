"""The documentation site: built strictly, then read in a browser that reaches nothing else."""

from __future__ import annotations

import functools
import http.server
import os
import shutil
import subprocess
import sys
import threading
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
CHROMIUM = shutil.which("chromium")
# The browser must not speak to anybody on its own account either.
QUIET = [
    *("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"),
    *("--disable-sync", "--no-first-run"),
]
WIDE, NARROW = 1280, 390
# Contrast of WCAG 2, level AA, of normal and of large text.
NORMAL, LARGE = 4.5, 3.0
# Every text that is shown, with its color and that of the ground behind it, mixed where they are transparent.
TEXTS = """() => {
    const parse = (css) => { const n = css.match(/[\\d.]+/g).map(Number); return n.length < 4 ? [...n, 1] : n };
    const over = (top, under) => under.map((c, k) => top[3] * top[k] + (1 - top[3]) * c);
    const found = [];
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) {
        const element = walker.currentNode.parentElement;
        const style = getComputedStyle(element);
        const seen = element.checkVisibility({opacityProperty: true, visibilityProperty: true});
        if (!seen || !walker.currentNode.data.trim()) continue;
        const grounds = [];
        for (let at = element; at; at = at.parentElement) grounds.unshift(parse(getComputedStyle(at).backgroundColor));
        const ground = grounds.reduce((under, top) => over(top, under), [255, 255, 255]);
        const size = parseFloat(style.fontSize);
        const large = size >= 24 || (size >= 18.66 && style.fontWeight >= 700);
        found.push([walker.currentNode.data.trim().slice(0, 40), over(parse(style.color), ground), ground, large]);
    }
    return found;
}"""


def require(present, what):
    """Skip where a tool is missing; where everything is set up for the tests that is a failure."""
    if not present:
        (pytest.fail if os.environ.get("CI") else pytest.skip)(f"{what} is needed")


def build(folder, site):
    """Build the project in a folder as scripts/docs does."""
    require(find_spec("mkdocs") and find_spec("material") and find_spec("mkdocstrings"), "the extra docs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--config-file", "-", "--site-dir", site]
    with (folder / "docs" / "mkdocs.yml").open() as config:
        return subprocess.run(
            command,
            stdin=config,
            cwd=folder,
            env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
            capture_output=True,
            text=True,
            check=False,
            timeout=200,
        )


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    done = build(ROOT, folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def address(site):
    """Where the site is served, on this machine only."""

    class Silent(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format, *args):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Silent, directory=site))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def browser():
    """A browser without a window."""
    require(CHROMIUM and find_spec("playwright"), "chromium with playwright")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        yield playwright.chromium.launch(executable_path=CHROMIUM, args=QUIET)


@pytest.fixture
def open_page(browser, address):
    """Opens pages of one width and color scheme; at the end nothing may have gone wrong in them."""
    contexts, wrong = [], []

    def open_one(width, scheme="light"):
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
        contexts.append(context)
        page = context.new_page()
        page.on("request", lambda request: request.url.startswith(address) or wrong.append(request.url))
        page.on("console", lambda message: message.type == "error" and wrong.append(message.text))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("response", lambda response: response.status >= 400 and wrong.append(response.url))
        return page

    yield open_one
    for context in contexts:
        context.close()
    # Icons of the stylesheets are addresses that hold their own data.
    assert [what for what in wrong if not what.startswith("data:")] == []


def names_of(site):
    return sorted(path.relative_to(site).as_posix() for path in site.rglob("*.html"))


def contrast(color, ground):
    """The ratio of WCAG 2."""

    def luminance(rgb):
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (v / 255 for v in rgb)]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    dark, bright = sorted((luminance(color), luminance(ground)))
    return (bright + 0.05) / (dark + 0.05)


def test_contrast_is_that_of_wcag():
    assert contrast((0, 0, 0), (255, 255, 255)) == 21.0
    assert round(contrast((0x76, 0x76, 0x76), (255, 255, 255)), 2) == 4.54


def test_a_broken_link_fails_the_build(tmp_path):
    shutil.copytree(DOCS, tmp_path / "docs")
    (tmp_path / "src").symlink_to(ROOT / "src")
    with (tmp_path / "docs" / "index.md").open("a") as page:
        page.write("\n[nowhere](nowhere.md)\n")
    done = build(tmp_path, tmp_path / "site")
    assert done.returncode != 0
    assert "nowhere.md" in done.stderr


def test_only_pages_and_pictures_are_published(site):
    endings = {path.suffix for path in site.rglob("*") if path.is_file()}
    assert not endings & {".py", ".yml", ".yaml", ".md"}


@pytest.mark.parametrize("width", [WIDE, NARROW])
def test_every_page_is_readable_and_asks_nobody_else(site, open_page, address, width):
    page = open_page(width)
    pages = names_of(site)
    assert len(pages) > 30
    too_wide = []
    for name in pages:
        page.goto(address + name)
        if page.evaluate("document.documentElement.scrollWidth > innerWidth"):
            too_wide.append(name)
    assert too_wide == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(
    "name", ["index.html", "how-to-choose.html", "gallery.html", "guides/time.html", "reference/design.html"]
)
def test_text_has_enough_contrast(open_page, address, name, scheme):
    page = open_page(WIDE, scheme)
    page.goto(address + name)
    texts = page.evaluate(TEXTS)
    assert len(texts) > 50
    faint = {
        (text, round(contrast(color, ground), 2))
        for text, color, ground, large in texts
        if contrast(color, ground) < (LARGE if large else NORMAL)
    }
    assert faint == set()


def test_the_search_finds_a_function(open_page, address):
    page = open_page(WIDE)
    page.goto(address + "index.html")
    page.locator(".md-search__input").fill("alpha_max")
    first = page.locator('.md-search-result__link[href*="reference/boundary.html"][href$="#zwidth.alpha_max"]').first
    first.wait_for(timeout=20_000)
    first.click()
    page.wait_for_url("**/reference/boundary.html**")


def test_the_palette_follows_the_reader(open_page, address):
    page = open_page(WIDE, "dark")
    page.goto(address + "index.html")
    scheme = page.locator("body")
    assert scheme.get_attribute("data-md-color-scheme") == "slate"
    page.locator('label[title="Light"]').click()
    assert scheme.get_attribute("data-md-color-scheme") == "default"
