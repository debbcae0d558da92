"""The documentation site: built with `--strict`, then read in a browser that may request nothing from elsewhere."""

from __future__ import annotations

import functools
import http.server
import os
import re
import shutil
import subprocess
import sys
import threading
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest
from browser import open_page
from waiting import LONGEST

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
WIDE, NARROW = 1280, 390
# Minimum contrast by WCAG 2, level AA, of normal and of large text.
NORMAL, LARGE = 4.5, 3.0
# Each visible text with its color and its background color, both blended over what lies behind them.
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

# Evaluated after the layout of the new window width has settled.
TOO_WIDE = """async () => {
    for (let k = 0; k < 2; k++) await new Promise(requestAnimationFrame);
    await Promise.allSettled(document.getAnimations().map(each => each.finished));
    return document.documentElement.scrollWidth > innerWidth;
}"""

CUT_OFF = """() => [...document.querySelectorAll(".formulas")]
    .filter((each) => each.scrollWidth > each.clientWidth + 1).map((each) => each.textContent)"""


def build(folder, site):
    """Build the project in a folder as scripts/docs does."""
    if not all(map(find_spec, ("mkdocs", "material", "mkdocstrings"))):
        (pytest.fail if os.environ.get("CI") else pytest.skip)("the extra docs is not installed: scripts/setup docs")
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
            timeout=LONGEST,
        )


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    result = build(ROOT, folder)
    assert result.returncode == 0, result.stderr
    return folder


@pytest.fixture(scope="module")
def address(site):
    """URL at which the site is served, on the loopback interface only."""

    class Silent(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format, *args):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Silent, directory=site))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    server.server_close()


@pytest.fixture
def read(browser):
    """Open a page of a given width and color scheme; on exit assert that it logged no errors and requested nothing."""

    @contextmanager
    def open_reader(width, scheme="light"):
        with open_page(browser, viewport={"width": width, "height": 900}, color_scheme=scheme) as page:
            yield page
            assert page.asked == []
            assert page.complaints == []

    return open_reader


def contrast(color, ground):
    """Contrast ratio defined by WCAG 2."""

    def luminance(rgb):
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (v / 255 for v in rgb)]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    dark, bright = sorted((luminance(color), luminance(ground)))
    return (bright + 0.05) / (dark + 0.05)


def test_contrast_ratio_matches_wcag_examples():
    assert contrast((0, 0, 0), (255, 255, 255)) == 21.0
    assert round(contrast((0x76, 0x76, 0x76), (255, 255, 255)), 2) == 4.54


def test_broken_link_fails_the_build(tmp_path):
    # A site of one page with the settings of the real one, without the slow reference pages.
    text = (DOCS / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[0]
    folder = tmp_path / "docs"
    shutil.copytree(DOCS / "stylesheets", folder / "stylesheets")
    shutil.copy(DOCS / "hooks.py", folder)
    (folder / "mkdocs.yml").write_text(re.sub(r"(?ms)^plugins:.*?(?=^\w)", "plugins: []\n", text), encoding="utf-8")
    (folder / "index.md").write_text("# Here\n\n[to itself](index.md), [to none](nowhere.md)\n", encoding="utf-8")
    result = build(tmp_path, tmp_path / "site")
    assert result.returncode == 1, result.stderr
    # The broken link is the only warning.
    assert "nowhere.md" in result.stderr
    assert result.stderr.count("WARNING") == 1


def test_sources_are_not_published(site):
    endings = {path.suffix for path in site.rglob("*") if path.is_file()}
    assert not endings & {".py", ".yml", ".yaml", ".md"}


def test_names_become_links_and_doctests_become_code(site):
    guide = (site / "how-to-choose.html").read_text(encoding="utf-8")
    assert 'href="reference/stability.html#zwidth.is_stable"' in guide
    pages = {page.name: page.read_text(encoding="utf-8") for page in (site / "reference").glob("*.html")}
    scene = set(re.findall(r'id="zwidth\.Scene\.(\w+)"', pages["scene.html"]))
    assert scene >= {"is_stable", "max_stiffness"}
    assert not scene & {"check_parts", "loop", "integer_delay"}
    for path in sorted((DOCS / "theory").glob("*.md")):
        html = (site / "theory" / f"{path.stem}.html").read_text(encoding="utf-8")
        prompts = re.findall("^>>>", path.read_text(encoding="utf-8"), re.MULTILINE)
        assert (path.stem, len(re.findall(">&gt;&gt;&gt; ?<", html))) == (path.stem, len(prompts))
    # Markdown turns ">>>" outside a code block into nested quotations.
    assert [name for name, text in pages.items() if "<blockquote" in text] == []
    assert pages["stability.html"].count('class="gp"') > 10
    # Each Returns section describes a single value, even if its description spans several lines.
    returned = [part for text in pages.values() for part in re.findall(r"(?s)Returns:.*?<ul>(.*?)</ul>", text)]
    assert len(returned) > 50
    assert {part.count("<li") for part in returned} == {1}


def test_pages_fit_the_window_and_load_nothing_external(site, address, read):
    pages = sorted(path.relative_to(site).as_posix() for path in site.rglob("*.html"))
    assert len(pages) > 30
    too_wide, cut_off = [], []
    with read(WIDE) as page:
        for name in pages:
            page.set_viewport_size({"width": WIDE, "height": 900})
            page.goto(address + name)
            # Load each page once and resize it, because loading dominates the time.
            for width in (WIDE, NARROW):
                page.set_viewport_size({"width": width, "height": 900})
                if page.evaluate(TOO_WIDE):
                    too_wide.append((name, width))
                # On narrow screens long formulas scroll.
                if width == WIDE:
                    cut_off += page.evaluate(CUT_OFF)
    assert too_wide == []
    assert cut_off == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_has_enough_contrast(address, read, scheme):
    faint, count = set(), 0
    with read(WIDE, scheme) as page:
        for name in ("index", "how-to-choose", "gallery", "guides/time", "reference/design"):
            page.goto(f"{address}{name}.html")
            for text, color, ground, large in page.evaluate(TEXTS):
                count += 1
                if contrast(color, ground) < (LARGE if large else NORMAL):
                    faint.add((name, text, round(contrast(color, ground), 2)))
    assert count > 1000
    assert faint == set()


def test_search_finds_a_function(address, read):
    with read(WIDE) as page:
        page.goto(address + "index.html")
        page.locator(".md-search__input").click()
        page.locator(".md-search__input").press_sequentially("alpha_max", delay=30)
        first = page.locator(
            '.md-search-result__link[href*="reference/boundary.html"][href$="#zwidth.alpha_max"]'
        ).first
        # The search index is built in the page, which is slow on a busy machine.
        first.wait_for()
        first.click()
        page.wait_for_url("**/reference/boundary.html**")


def test_palette_follows_the_preferred_color_scheme(address, read):
    with read(WIDE, "dark") as page:
        page.goto(address + "index.html")
        scheme = page.locator("body")
        assert scheme.get_attribute("data-md-color-scheme") == "slate"
        page.locator('label[title="Light"]').click()
        assert scheme.get_attribute("data-md-color-scheme") == "default"
