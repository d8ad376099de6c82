"""The slides in a browser, on a laptop's projector."""

import pytest

NAMES = ("00_start_here", "02_region_refinement")
OWN_WISH = "/favicon.ico"  # the browser asks any server for it once; a deck names none


def show(driver, address):
    """Open a deck on a screen of 1366 x 768."""
    size = {"width": 1366, "height": 768, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    driver.get(address)


@pytest.mark.parametrize("name", NAMES)
def test_a_deck_asks_nobody_else(driver, journal, decks, name):
    journal.complaints(), journal.traffic()
    show(driver, f"{decks}{name}.html")
    foreign, missing = journal.traffic()
    assert foreign == [] and [address for address in missing if not address.endswith(OWN_WISH)] == []
    assert [line for line in journal.complaints() if OWN_WISH not in line] == []


LEAST_PX = 301  # beside much text a figure is not made lower than 300,
SMALLEST_PX = 16  # and text not smaller than this; then the slide scrolls
CUT = """
const [LEAST, SMALLEST, done] = arguments;
const frame = () => new Promise(next => requestAnimationFrame(() => requestAnimationFrame(next)));
async function look() {
  while (!window.Reveal?.isReady()) await frame();
  await MathJax.startup.promise;
  const cut = [];
  for (const slide of Reveal.getSlides()) {
    const {h, v} = Reveal.getIndices(slide);
    Reveal.slide(h, v);
    await frame();
    const has_text = slide.innerText.trim() !== "", figures = [...slide.querySelectorAll("img")];
    const rest = slide.scrollHeight - slide.clientHeight;
    const large = figures.some(figure => !has_text || figure.clientHeight > LEAST);
    const words = [...slide.querySelectorAll(".jp-Cell")].map(cell => parseFloat(getComputedStyle(cell).fontSize));
    if (rest > 1 && (large || Math.max(...words) > SMALLEST)) cut.push(`${h}/${v}: ${rest} px`);
  }
  return cut;
}
look().then(done, error => done([String(error)]));
"""


@pytest.mark.parametrize("name", NAMES)
def test_figures_and_text_give_way_before_a_slide_scrolls(driver, decks, name):
    show(driver, f"{decks}{name}.html")
    assert driver.execute_async_script(CUT, LEAST_PX, SMALLEST_PX) == []
