"""Commands that are interrupted, told to end, or killed: one line, and no process stays behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import soak

psutil = pytest.importorskip("psutil")
pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 60


def until(happened):
    """Wait until something has happened."""
    end = time.monotonic() + PATIENCE_S
    while not happened() and time.monotonic() < end:
        time.sleep(0.1)
    assert happened()


@pytest.mark.parametrize(
    ("sent", "code", "line"),
    [
        (signal.SIGINT, 130, "ditr_lite: interrupted\n"),
        (signal.SIGTERM, 143, "ditr_lite: ended by SIGTERM\n"),
        (signal.SIGKILL, -9, None),
    ],
)
def test_no_worker_outlives_a_simulation(tmp_path, sent, code, line):
    pytest.importorskip("mitsuba")
    argv = [sys.executable, "-m", "ditr_lite", "simulate", "--split", "train", "--count", "40", "--workers", "2"]
    quiet = {**os.environ, "TQDM_DISABLE": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with soak.listening_to_ctrl_c():
        process = subprocess.Popen(
            [*argv, "--out", str(tmp_path)], cwd=ROOT, env=quiet, start_new_session=True, **pipes
        )
    parent = psutil.Process(process.pid)
    until(lambda: len(parent.children(recursive=True)) >= 2)
    workers = parent.children(recursive=True)
    if sent == signal.SIGINT:  # as a terminal does: to all of them
        os.killpg(process.pid, sent)
    else:
        process.send_signal(sent)
    printed, complained = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code and (line is None or (printed, complained) == ("", line))
    _, alive = psutil.wait_procs(workers, timeout=PATIENCE_S)
    assert not alive


DROPPED = """
import os, signal, sys, time
from ditr_lite import cli

class Thing:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.2)  # the exception comes up here, and Python drops it

def run(options):
    Thing()
    time.sleep(60)

cli.train.Train.run = staticmethod(run)
sys.exit(cli.main(["train", "--part", "region"]))
"""


def test_a_signal_in_a_destructor_ends_the_command_too():
    done = subprocess.run([sys.executable, "-c", DROPPED], cwd=ROOT, timeout=PATIENCE_S, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (143, "", "ditr_lite: ended by SIGTERM\n")
