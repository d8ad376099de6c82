"""The notebooks in JupyterLab, as their readers use them: run all, move a slider, turn a cloud."""

import time

import pytest

pytestmark = pytest.mark.usefixtures("picture")
RUN_LIMIT_S = 360
STATE = """
const content = window.jupyterapp?.shell.currentWidget?.content;
if (!content?.model) return null;
const cells = [...content.model.cells].filter(c => c.type === "code");
return {
  session: window.jupyterapp.shell.currentWidget.sessionContext.session?.kernel?.status ?? "",
  waiting: cells.filter(c => c.executionCount === null || c.executionState === "running").length,
  errors: cells.flatMap(c => c.outputs.toJSON()).filter(o => o.output_type === "error").map(o => o.evalue),
};
"""


def wait_for(condition, what, seconds=120):
    """Return what ``condition`` gives as soon as it is true; fail after so many seconds."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        value = condition()
        if value:
            return value
        time.sleep(0.25)
    pytest.fail(f"waited {seconds} s for {what}")


def open_notebook(driver, lab, name):
    """Open a notebook with the token in the address, all outputs cleared, and wait for its kernel."""
    address, token = lab
    size = {"width": 1400, "height": 1100, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    driver.get(f"{address}/lab/tree/notebooks/{name}.ipynb?token={token}&reset")
    wait_for(lambda: (driver.execute_script(STATE) or {}).get("session") == "idle", f"the kernel of {name}")
    driver.execute_script("return window.jupyterapp.commands.execute('notebook:clear-all-cell-outputs')")


def choose(driver, menu, entry):
    """Click a menu's entry, as a reader does."""
    driver.find_element("xpath", f"//ul[@role='menubar']//div[normalize-space()='{menu}']").click()
    path = f"//ul[@role='menu']//div[contains(@class, 'itemLabel') and normalize-space()='{entry}']"
    wait_for(lambda: driver.find_elements("xpath", path), f"{menu} > {entry}", 20)[0].click()


def run_to_first(driver, words):
    """Run the notebook as far as the first code cell that holds ``words``, and bring that cell into view."""
    script = """
    const [words, done] = arguments, {shell, commands} = window.jupyterapp, panel = shell.currentWidget;
    const k = [...panel.content.model.cells].findIndex(c => c.type === "code" && c.sharedModel.source.includes(words));
    panel.content.activeCellIndex = k;
    commands.execute("notebook:run-all-above").then(() => {
      panel.content.activeCellIndex = k;
      return commands.execute("notebook:run-cell");
    }).then(() => panel.content.scrollToItem(k, "start")).then(() => done(k), error => done(String(error)));
    """
    driver.set_script_timeout(RUN_LIMIT_S)
    cell = driver.execute_async_script(script, words)
    assert isinstance(cell, int) and cell >= 0, cell
    assert driver.execute_script(STATE)["errors"] == []


def test_the_first_notebook_runs_to_its_end(driver, lab):
    open_notebook(driver, lab, "00_start_here")
    choose(driver, "Run", "Run All Cells")
    state = wait_for(
        lambda: (s := driver.execute_script(STATE)) and s["session"] == "idle" and not s["waiting"] and s,
        "00_start_here to run",
        RUN_LIMIT_S,
    )
    assert state["errors"] == []


UNDESCRIBED = """
const cells = [...window.jupyterapp.shell.currentWidget.content.model.cells];
const alts = new Set(cells.map(cell => cell.getMetadata("alt")).filter(words => words));
return [...document.querySelectorAll(".jp-OutputArea img, .jp-OutputArea .js-plotly-plot")].map(
  e => e.alt || e.getAttribute("aria-label") || "").filter(words => !alts.has(words));
"""


def described(driver):
    """Wait until all pictures, of which there is one, have the words that stand in their cells' metadata."""
    wait_for(lambda: driver.execute_script(UNDESCRIBED) == [], "words for every picture")


def test_a_slider_changes_its_picture(driver, lab):
    from selenium.webdriver.common.keys import Keys

    open_notebook(driver, lab, "01_depth_loss_anatomy")
    run_to_first(driver, "knobs(")
    picture = wait_for(lambda: driver.find_elements("css selector", ".jp-OutputArea img.widget-image"), "a picture")[0]
    before = picture.get_attribute("src")
    handle = driver.find_element("css selector", ".jp-OutputArea .noUi-handle")
    handle.send_keys(Keys.ARROW_RIGHT)
    wait_for(lambda: picture.get_attribute("src") != before, "the picture to change")
    assert int(picture.get_property("naturalWidth")) > 100
    described(driver)


def test_a_cloud_turns(driver, lab):
    from selenium.webdriver.common.action_chains import ActionChains

    open_notebook(driver, lab, "09_your_own_camera")
    run_to_first(driver, "Interactive(")
    plot = ".jp-OutputArea .js-plotly-plot"
    scene = f"document.querySelector('{plot}')?._fullLayout?.scene?._scene"
    eye = f"return {scene}?.getCamera?.()?.eye ?? null"
    before = wait_for(lambda: driver.execute_script(eye), "the cloud", 30)
    cloud = driver.find_element("css selector", f"{plot} canvas")
    driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", cloud)
    time.sleep(1)  # pictures above are still being laid out
    hand = ActionChains(driver).move_to_element(cloud).click_and_hold()
    for _ in range(6):
        hand = hand.move_by_offset(12, 4).pause(0.15)
    hand.release().perform()
    wait_for(lambda: driver.execute_script(eye) != before, "the cloud to turn", 20)
    described(driver)


def test_jupyterlab_reports_no_error_of_ours(driver, journal, lab):
    ours = [line for line in journal.complaints() if "plotly" in line.lower() or "widget" in line.lower()]
    assert ours == []
