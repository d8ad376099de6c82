"""A few hundred damaged files of every kind; ``python tests/fuzz.py`` tries 20,000."""

import fuzz
import numpy as np
import pytest

from ditr_lite import datasets

FILES = 400


def test_no_damaged_file_gets_past_a_reader():
    found = fuzz.fuzz(FILES, 0)
    wrong = [key for key in found if key[1] not in ("read", "refused")]
    assert not wrong and found.total() == FILES
    assert {*fuzz.SINGLE, *datasets.REGISTRY, "scene", "weights"} == {kind for kind, _ in found}


@pytest.mark.parametrize(
    ("read", "said"),
    [(lambda folder: 1 / 0, "ZeroDivisionError"), (lambda folder: int("two\nlines"), "refused")],
)
def test_what_a_reader_does_is_told(tmp_path, read, said):
    (tmp_path / "a").write_bytes(b"whole")
    outcome = fuzz.attempt(fuzz.Target("mine", {"a": b"whole"}, "a", read), tmp_path, np.random.default_rng(0))
    assert said in outcome and (tmp_path / "a").read_bytes() == b"whole"


def test_a_crash_and_a_hang_are_counted(monkeypatch):
    monkeypatch.setattr(fuzz.sys, "executable", "/bin/false")
    assert [outcome for _, outcome in fuzz.batch(3, 7)] == ["seed 7: ended with 1: "]

    def never(command, timeout, **_):
        raise fuzz.subprocess.TimeoutExpired(command, timeout)

    monkeypatch.setattr(fuzz.subprocess, "run", never)
    assert [outcome for _, outcome in fuzz.batch(3, 7)] == ["seed 7: hung"]
