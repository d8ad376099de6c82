"""Every page of the book in a browser: typeset, described, reachable, within its width, and asking nobody else."""

import base64
import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag

import pytest

AXE = (Path(__file__).parent / "axe-core-4.14.1" / "axe.min.js").read_text(encoding="utf-8")
TYPESET = """
const done = arguments[arguments.length - 1];
const finished = window.MathJax && MathJax.startup ? MathJax.startup.promise : Promise.resolve();
finished.then(() => done({
  waiting: [...document.querySelectorAll(".math")].filter(m => !m.querySelector("mjx-container")).length,
  failed: document.querySelectorAll("mjx-merror, [data-mml-node='merror']").length,
}));
"""
RUN_AXE = """
const done = arguments[arguments.length - 1];
axe.run(document, {resultTypes: ["violations"], runOnly: arguments[0]}).then(
  result => done(result.violations.filter(v => ["serious", "critical"].includes(v.impact)).map(
    v => v.id + ": " + v.nodes.slice(0, 3).map(n => n.target.join(" ")).join(" | "))),
  error => done(["axe: " + error]));
"""
BEYOND = "return document.documentElement.scrollWidth - window.innerWidth"  # px that a page is wider than it is shown
STANDARDS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"]


def axe(driver, rules):
    driver.execute_script(AXE)
    return driver.execute_async_script(RUN_AXE, rules)


def show(driver, address, width=1280, height=900, scheme="light"):
    """Open a page at a size and in light or dark."""
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    feature = {"name": "prefers-color-scheme", "value": scheme}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    driver.get(address)
    return driver.execute_async_script(TYPESET)


def pages(book):
    return sorted(path.relative_to(book).as_posix() for path in book.rglob("*.html"))


@pytest.fixture(scope="module")
def found(driver, journal, book, site):
    """What is wrong with each page, by kind, after one visit to each at phone width and one at full width."""
    kinds = ("console", "foreign", "missing", "axe", "maths", "width")
    problems = {kind: {} for kind in kinds}
    journal.complaints(), journal.traffic()
    for page in pages(book):
        maths = show(driver, site + page, width=390, height=844)
        wide = [driver.execute_script(BEYOND)]
        size = {"width": 1280, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        wide.append(driver.execute_script(BEYOND))
        foreign, missing = journal.traffic()
        here = {
            "console": journal.complaints(),
            "foreign": foreign,
            "missing": missing,
            "axe": axe(driver, STANDARDS),
            "maths": [maths] if any(maths.values()) else [],
            "width": wide if max(wide) > 0 else [],
        }
        for kind in kinds:
            if here[kind]:
                problems[kind][page] = here[kind]
    return problems


def test_no_page_has_an_error_in_the_console(found):
    assert found["console"] == {}


def test_no_page_asks_another_host_or_for_what_is_not_there(found):
    assert found["foreign"] == {} and found["missing"] == {}


def test_all_mathematics_is_typeset(found):
    assert found["maths"] == {}


def test_no_page_is_wider_than_a_phone_or_a_laptop(found):
    assert found["width"] == {}


NARROW = """
return [...document.querySelectorAll(".cell_output img")].map(e => [e.clientWidth, e.naturalWidth]).filter(
  ([shown, own]) => !own || shown < Math.min(own, arguments[0]));
"""
COLUMN_PX = 736  # shown so wide, a figure's smallest type is 12 pixels high


@pytest.mark.parametrize("width", [390, 768, 1024, 1280, 1312, 1366, 1920])
def test_figures_are_shown_at_a_size_at_which_their_words_can_be_read(driver, site, width):
    show(driver, site + "notebooks/04_ddpm_math.html", width=width)
    assert driver.execute_script(NARROW, COLUMN_PX) == []
    assert driver.execute_script(BEYOND) <= 0


def test_axe_finds_nothing_serious(found):
    assert found["axe"] == {}


@pytest.mark.parametrize("page", ["index.html", "symbols.html", "api/diffusion.html", "notebooks/04_ddpm_math.html"])
def test_contrast_holds_in_the_dark(driver, site, page):
    show(driver, site + page, scheme="dark")
    dark = driver.execute_script("return getComputedStyle(document.body).backgroundColor")
    assert max(map(int, re.findall(r"\d+", dark)[:3])) < 60
    assert axe(driver, {"type": "rule", "values": ["color-contrast"]}) == []


def test_search_finds_a_word(driver, journal, site):
    from selenium.webdriver.common.keys import Keys
    from selenium.webdriver.support.ui import WebDriverWait

    show(driver, site + "index.html")
    driver.find_element("css selector", "input.sidebar-search").send_keys("straight-through", Keys.ENTER)
    hits = WebDriverWait(driver, 20).until(lambda d: d.find_elements("css selector", "#search-results li a"))
    assert any("03_vq_autoencoder" in hit.get_attribute("href") for hit in hits)
    hits[0].click()
    WebDriverWait(driver, 20).until(lambda d: "search.html" not in d.current_url)
    assert journal.complaints() == []


FOCUSABLE = """
return [...document.querySelectorAll("a[href], button, input, summary, label[for], [tabindex='0']")].filter(
  e => e.tagName !== "LABEL" && e.checkVisibility({visibilityProperty: true, opacityProperty: true})
       && e.getClientRects().length && e.type !== "hidden" && e.tabIndex >= 0).map(
  (e, k) => (e.dataset.stop = k, (e.textContent || e.placeholder || e.tagName).trim().slice(0, 40)));
"""


def test_the_tab_key_reaches_all_that_can_be_used(driver, site):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    show(driver, site + "index.html")
    stops = driver.execute_script(FOCUSABLE)
    assert len(stops) > 20
    reached = set()
    for _ in range(len(stops) + 10):
        ActionChains(driver).send_keys(Keys.TAB).perform()
        reached.add(driver.execute_script("return document.activeElement.dataset.stop"))
    assert [stop for k, stop in enumerate(stops) if str(k) not in reached] == []


def test_the_theme_can_be_switched_and_is_remembered(driver, site):
    show(driver, site + "index.html")
    driver.find_element("css selector", ".content-icon-container .theme-toggle, .theme-toggle-content button").click()
    chosen = driver.execute_script("return document.body.dataset.theme")
    show(driver, site + "glossary.html")
    assert driver.execute_script("return document.body.dataset.theme") == chosen != "auto"
    driver.execute_script("localStorage.clear()")


def test_the_cheat_sheet_prints_on_two_pages(driver, site):
    show(driver, site + "symbols.html")
    options = {"preferCSSPageSize": True, "printBackground": False}
    pdf = base64.b64decode(driver.execute_cdp_cmd("Page.printToPDF", options)["data"])
    assert len(re.findall(rb"/Type\s*/Page\b", pdf)) <= 2


# --- without a browser ------------------------------------------------------------------------------------------------


class Page(HTMLParser):
    """Links, anchors and pictures of a page."""

    def __init__(self, text):
        super().__init__()
        self.links, self.anchors, self.alternatives = [], set(), []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.anchors |= {values[key] for key in ("id", "name") if values.get(key)}
        if tag == "img":
            self.alternatives.append((values.get("src", ""), values.get("alt")))
        for key in ("href", "src"):
            if values.get(key) and tag != "link":
                self.links.append(values[key])


@pytest.fixture(scope="module")
def parsed(book):
    return {page: Page((book / page).read_text(encoding="utf-8")) for page in pages(book)}


def test_nothing_is_left_beside_the_book(book):
    assert [path.name for path in book.parent.iterdir()] == ["book"]


def test_no_link_is_broken(book, parsed):
    broken = []
    for page, content in parsed.items():
        for link in content.links:
            if re.match(r"[a-z]+:", link):
                continue
            path, anchor = urldefrag(unquote(link))
            target = (book / page).parent.joinpath(path.split("?")[0]).resolve() if path else book / page
            if not target.is_file():
                broken.append((page, link))
            elif anchor and target.suffix == ".html":
                if anchor not in parsed[target.relative_to(book.resolve()).as_posix()].anchors:
                    broken.append((page, link))
    assert broken == []


def test_every_picture_has_alternative_text(parsed):
    empty = [
        (page, source)
        for page, content in parsed.items()
        for source, words in content.alternatives
        if not words or len(words) < 15 or re.search(r"\.(png|jpg|svg)$|^<Figure", words)
    ]
    assert empty == []


def test_every_notebook_has_its_page_core_and_downloads(book, parsed):
    names = [path.stem for path in (Path(__file__).parents[2] / "notebooks").glob("*.ipynb")]
    for name in names:
        links = parsed[f"notebooks/{name}.html"].links
        assert f"../summaries/{name}.html" in links
        assert len([link for link in links if link.endswith(f"{name}.ipynb")]) == 2
        assert (book / "summaries" / f"{name}.html").is_file()


def test_solutions_are_folded(book):
    text = (book / "notebooks" / "00_start_here.html").read_text(encoding="utf-8")
    assert text.count("Show a solution") == text.count("BEGIN SOLUTION") > 0
    assert text.count("your turn: replace this line") >= text.count("BEGIN SOLUTION")
