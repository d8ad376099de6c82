import json
from dataclasses import replace

import numpy as np
import pytest

from ditr_lite.data import load_sample
from ditr_lite.peers import compare
from ditr_lite.pipeline import Ditr
from ditr_lite.store import save_part


@pytest.fixture(scope="module")
def ditr():
    return Ditr.from_pretrained()


@pytest.fixture(scope="module")
def frames(ditr):
    return compare.frames_of(ditr, [load_sample("val_00000"), load_sample("val_00001")])


def test_stage_one_is_asked_once_a_frame_for_both_masks(ditr, frames):
    sample, found = frames[0]
    assert np.array_equal(found.region, ditr(sample.rgb, sample.depth).region)
    assert not np.array_equal(found.region, found.unrefined)


def test_every_row_is_asked_about_every_frame_once(frames, tmp_path):
    asked = []

    def truth(sample, found):
        asked.append(sample.name)
        return np.where(sample.depth_gt > 0, sample.depth_gt, 1)

    def score(key, some=frames):
        return compare.score_rows({"truth, told": (truth, key)}, some, tmp_path, compare.score_rendered)

    first = score("a", frames[:1])
    assert first[frames[0][0].name]["truth, told"]["optical"] == 0
    both = score("a")
    assert set(both) == {s.name for s, _ in frames} and len(asked) == 2  # the first is not asked about again
    score("b")
    assert len(asked) == 4  # other weights: everything anew
    assert json.loads((tmp_path / "truth_told.json").read_text())["key"] == "b"
    score("c", frames[:1]), score("c")
    assert len(asked) == 6  # what other weights made of the second frame is not theirs
    farther, found = replace(frames[0][0], depth_gt=2 * frames[0][0].depth_gt), frames[0][1]
    again = compare.score_rows({"truth, told": (truth, "c")}, [(farther, found)], tmp_path, compare.score_rendered)
    assert len(asked) == 7 and again[farther.name]["truth, told"]["optical"] == 0  # another truth of the same name


def test_the_shipped_row_is_the_system(ditr, frames):
    sample, found = frames[0]
    depth = compare.shipped_methods(ditr)["ditr"](sample, found)
    assert np.array_equal(depth, ditr(sample.rgb, sample.depth).depth)


def test_a_study_needs_trained_arms(ditr, tmp_path):
    with pytest.raises(ValueError, match="no weights in"):
        compare.methods(ditr, tmp_path)
    save_part("bb-0", {}, ditr.config, tmp_path, {"arm": "bb", "seed": 0})
    with pytest.raises(ValueError, match="holds no trained 'ditr'"):
        compare.methods(ditr, tmp_path)


FRAMES = """
import numpy as np
def frames():
    depth = np.ones((8, 8)); depth[0, 0] = np.nan
    yield "one", np.zeros((8, 8, 3), np.uint8), depth, None, np.eye(8, dtype=bool)
"""


def test_real_frames_come_from_a_file_of_the_readers_own(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(FRAMES)
    (sample,) = compare.frames_of_file(file)
    assert sample.name == "one" and sample.depth[0, 0] == 0 and sample.depth.dtype == np.float32
    depth = sample.depth + 0.05
    assert compare.score_real(depth, sample)["moved"] == 1  # of the readings outside the region, the diagonal
    half = np.where(np.arange(8) < 4, depth, sample.depth)
    assert compare.score_real(half, sample)["moved"] == pytest.approx(0.5)
    assert compare.score_real(sample.depth, sample)["moved"] == 0
    unknown = replace(sample, region=None)
    assert compare.score_real(half, unknown) == {"moved": None}  # it may be glass that moved
    moved = compare.score_real(half, replace(unknown, name="desk (no glass)"))["moved"]
    assert moved == pytest.approx(31 / 63, abs=1e-6)
    file.write_text("x = 1")
    with pytest.raises(ValueError, match="defines no frames"):
        compare.frames_of_file(file)
    with pytest.raises(ValueError, match="no such file"):
        compare.frames_of_file(tmp_path / "absent.py")
