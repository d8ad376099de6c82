"""Damaged files of every kind: each reader returns or raises a ValueError in one line; none crashes, none hangs.

``DITR_FUZZ=20000 python -m pytest tests/test_fuzz.py`` tries so many instead of a few.
"""

import os
import time

import input_cases
import numpy as np
import pytest

from ditr_lite import files

FILES = int(os.environ.get("DITR_FUZZ", 400))
SLOWEST_S = 10.0
READERS = (files.read_depth, files.read_rgb, files.read_mask, lambda path: files.read_intrinsics(path, (24, 32)))
KINDS = {"depth": 0, "container": 0, "colour": 1, "mask": 2, "camera": 3}
SEEDS = [case for case in input_cases.table() if case.name.partition("|")[0] in KINDS and "absent" not in case.name]


def mutated(data, rng):
    """Return bytes with some changed, cut out, put in twice, or replaced by extremes."""
    data = bytearray(data)
    for _ in range(int(rng.integers(1, 6))):
        if not data:
            break
        at, length = int(rng.integers(len(data))), int(rng.integers(1, 1 + min(64, len(data))))
        kind = rng.integers(5)
        if kind == 0:
            data[at] = int(rng.integers(256))
        elif kind == 1:
            del data[at : at + length]
        elif kind == 2:
            data[at:at] = data[at : at + length]
        elif kind == 3:
            data[at : at + 4] = bytes([int(rng.choice([0, 127, 128, 255]))] * 4)
        else:
            del data[at:]
    return bytes(data)


@pytest.mark.filterwarnings("ignore")
def test_no_damaged_file_crashes_a_reader(tmp_path):
    rng = np.random.default_rng(int(os.environ.get("DITR_FUZZ_SEED", 0)))
    originals = []
    for k, case in enumerate(SEEDS):
        path = tmp_path / f"{k}{os.path.splitext(case.name)[1]}"
        case.write(path)
        originals.append((KINDS[case.name.partition("|")[0]], path.suffix, path.read_bytes()))
        path.unlink()
    accepted = 0
    for k in range(FILES):
        reader, suffix, data = originals[k % len(originals)]
        path = tmp_path / f"m{suffix}"
        path.write_bytes(mutated(data, rng))
        started = time.monotonic()
        try:
            READERS[reader](path)
            accepted += 1
        except ValueError as error:
            assert "\n" not in str(error), error
        assert time.monotonic() - started < SLOWEST_S
    assert accepted < FILES
