"""A browser, the built book behind a server, and JupyterLab: what the tests of this folder share.

Nothing but 127.0.0.1 can be reached from this browser: a page that asks another host is found out, and gets no answer.
"""

import contextlib
import functools
import http.server
import json
import os
import secrets
import shutil
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NAMES = {
    "CHROME": ("chromium", "chromium-browser", "google-chrome", "chrome"),
    "CHROMEDRIVER": ("chromedriver", "chromium.chromedriver"),
}
OWN = ("http://127.0.0.1:", "ws://127.0.0.1:", "data:", "blob:", "chrome", "about:")  # addresses that ask nobody
NEWS = "@jupyterlab/apputils-extension:announcements"  # would cover a corner of the page with a question
START_S = 60  # for JupyterLab to answer


def program(variable):
    """Return the path of the browser or its driver, from the environment or from the PATH; None where there is none."""
    return os.environ.get(variable) or next(filter(None, map(shutil.which, NAMES[variable])), None)


@pytest.fixture(scope="session")
def driver():
    """A headless Chromium. Without one, tests skip, unless BROWSER_TESTS=required says that this is a failure."""
    if not all(map(program, NAMES)):
        message = (
            "no Chromium with its driver: apt-get install chromium chromium-driver, or set CHROME and CHROMEDRIVER"
        )
        (pytest.fail if os.environ.get("BROWSER_TESTS") == "required" else pytest.skip)(message)
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = program("CHROME")
    options.add_argument("--headless=new")
    options.add_argument("--window-size=1280,900")
    options.add_argument("--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1")
    options.add_argument("--enable-unsafe-swiftshader")  # WebGL without a graphics card
    options.add_argument("--disable-dev-shm-usage")  # containers have little of it
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        options.add_argument("--no-sandbox")  # as root, in a container, Chromium refuses to start with it
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    browser = webdriver.Chrome(options=options, service=Service(program("CHROMEDRIVER")))
    browser.set_script_timeout(120)
    yield browser
    browser.quit()


@pytest.fixture
def picture(request, driver):
    """Leave a picture of what the browser shows at the end of a test in outputs/browser, for eyes."""
    yield
    folder = ROOT / "outputs" / "browser"
    folder.mkdir(parents=True, exist_ok=True)
    driver.save_screenshot(str(folder / f"{request.node.name}.png"))


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Files of a folder, without a line on stderr for each."""

    def log_message(self, *_):
        pass


@pytest.fixture(scope="session")
def book(tmp_path_factory):
    """The folder of the book, built as ``make book`` does."""
    out = tmp_path_factory.mktemp("site") / "book"
    command = [sys.executable, str(ROOT / "book" / "build.py"), "--out", str(out)]
    run = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert run.returncode == 0, run.stderr
    return out


@contextlib.contextmanager
def served(folder):
    """Give a folder's address on 127.0.0.1, with a slash at its end."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()


@pytest.fixture(scope="session")
def site(book):
    """The book's address."""
    with served(book) as address:
        yield address


@pytest.fixture(scope="session")
def decks(tmp_path_factory):
    """The address of a folder with all slides, made as ``make slides`` does."""
    out = tmp_path_factory.mktemp("decks")
    command = [sys.executable, str(ROOT / "tools" / "slides.py"), "--out", str(out)]
    run = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    if run.returncode:  # reveal.js and MathJax come from npm once, which needs a network
        (pytest.fail if os.environ.get("BROWSER_TESTS") == "required" else pytest.skip)(run.stderr)
    with served(out) as address:
        yield address


class Journal:
    """What the browser has noted since it was last asked."""

    def __init__(self, browser):
        self.browser = browser

    def traffic(self):
        """Return (addresses asked of other hosts, addresses answered with 400 and more)."""
        foreign, failed = [], []
        for entry in self.browser.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            if message["method"] == "Network.requestWillBeSent":
                address = message["params"]["request"]["url"]
                if not address.startswith(OWN):
                    foreign.append(address)
            if message["method"] == "Network.responseReceived" and message["params"]["response"]["status"] >= 400:
                failed.append(message["params"]["response"]["url"])
        return foreign, failed

    def complaints(self):
        """Return what the console called an error."""
        return [entry["message"] for entry in self.browser.get_log("browser") if entry["level"] == "SEVERE"]


@pytest.fixture(scope="session")
def journal(driver):
    """What the browser notes of its traffic and its console."""
    return Journal(driver)


@pytest.fixture(scope="session")
def lab(tmp_path_factory):
    """JupyterLab on 127.0.0.1 over a copy of the notebooks, as (address, token); nobody's settings, nobody's files."""
    home = tmp_path_factory.mktemp("lab")
    shutil.copytree(ROOT / "notebooks", home / "notebooks")
    quiet = home / "jupyter_config_dir" / "labconfig" / "page_config.json"
    quiet.parent.mkdir(parents=True)
    quiet.write_text(json.dumps({"disabledExtensions": {NEWS: True}}), encoding="utf-8")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    token = secrets.token_hex(16)
    places = ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR")
    environment = os.environ | {name: str(home / name.lower()) for name in places}
    environment |= {"JUPYTER_TOKEN": token, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "2"}
    for name in ("JUPYTERLAB_SETTINGS_DIR", "JUPYTERLAB_WORKSPACES_DIR"):
        environment[name] = str(home / name.lower())
    environment.pop("MPLBACKEND", None)
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--ip=127.0.0.1", f"--port={port}"]
    command += ["--ServerApp.port_retries=0", f"--notebook-dir={home}", "--LabApp.expose_app_in_browser=True"]
    command.append(f"--LabApp.extra_labextensions_path={ROOT / 'tools' / 'labextensions'}")
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        command.append("--allow-root")
    with (home / "log").open("w") as log:
        server = subprocess.Popen(command, env=environment, stdout=log, stderr=log, cwd=home)
        try:
            _await_answer(f"http://127.0.0.1:{port}/api/status?token={token}", server, home / "log")
            yield f"http://127.0.0.1:{port}", token
        finally:
            server.terminate()
            server.wait(timeout=30)


def _await_answer(address, server, log):
    end = time.monotonic() + START_S
    while time.monotonic() < end and server.poll() is None:
        try:
            with urllib.request.urlopen(address, timeout=5):
                return
        except OSError:
            time.sleep(0.3)
    pytest.fail(f"JupyterLab did not answer within {START_S} s: {log.read_text()[-2000:]}")
