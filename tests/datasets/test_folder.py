"""A folder of one's own, made of real frames where there are any beside the repository."""

import shutil
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest

from ditr_lite import datasets, files, pipeline
from ditr_lite.config import preset
from ditr_lite.data import load_sample
from ditr_lite.viz import clouds

REAL = Path(__file__).resolve().parents[3] / "shared" / "real"
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason="no real frames beside the repository")


def test_the_expected_layout_is_named_and_splits_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"no Folder frames in .*: expected rgb/NAME"):
        datasets.Folder(tmp_path)
    with pytest.raises(ValueError, match="unknown split 'test' of Folder; it has no splits: give none"):
        datasets.Folder(tmp_path, "test")


@needs_real
def test_real_frames_go_from_two_files_to_a_cloud(tmp_path):
    for key, ending in (("2", "png"), ("6", "jpg")):
        for source, target in ((f"rgb.{ending}", f"rgb/{key}.{ending}"), ("raw_depth.png", f"depth/{key}.png")):
            (tmp_path / target).parent.mkdir(exist_ok=True)
            shutil.copy(REAL / "lingbot" / key / source, tmp_path / target)
    shutil.copy(REAL / "lingbot" / "2" / "intrinsics.txt", tmp_path / "intrinsics.txt")
    config = preset("tiny")
    ditr = pipeline.Ditr(pipeline.build(config), config)
    for sample in datasets.Folder(tmp_path):
        out = ditr(sample.rgb, sample.depth)
        kept = (sample.depth > 0) & ~out.region
        assert np.isfinite(out.depth).all() and (out.depth > 0).all()
        assert np.array_equal(out.depth[kept], sample.depth[kept])
        assert files.write_ply(tmp_path / "c.ply", out.depth, sample.rgb, sample.camera) == out.depth.size
        assert len(clouds.points_of(out.depth, sample.rgb, sample.camera, 1000)[0]) > 500


@pytest.mark.parametrize("swapped", [False, True])
def test_a_folder_whose_raw_depth_and_truth_are_swapped_is_warned_of(tmp_path, swapped):
    scene = load_sample("val_00001")
    files.write_picture(tmp_path / "rgb" / "a.png", scene.rgb)
    files.write_picture(tmp_path / "region" / "a.png", 255 * scene.region.astype(np.uint8))
    for name, depth in (("depth", scene.depth), ("truth", scene.depth_gt)):
        other = {"depth": "truth", "truth": "depth"}[name]
        files.write_depth(tmp_path / (other if swapped else name) / "a.png", depth)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert datasets.Folder(tmp_path)[0].depth.any()
    assert ["raw depth and truth look swapped" in str(w.message) for w in said] == [True] * swapped


def test_a_scale_is_of_truth_in_numbers_of_the_same_kind(tmp_path):
    for folder in ("rgb", "depth", "truth"):
        (tmp_path / folder).mkdir()
    cv2.imwrite(str(tmp_path / "rgb" / "a.png"), np.zeros((4, 6, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "depth" / "a.png"), np.full((4, 6), 4000, np.uint16))  # 0.2 mm
    np.save(tmp_path / "truth" / "a.npy", np.full((4, 6), 0.8, np.float32))
    sample = datasets.Folder(tmp_path, depth_scale=0.0002)["depth/a.png"]
    assert np.allclose(sample.depth, 0.8) and np.allclose(sample.depth_gt, 0.8)
    with pytest.warns(UserWarning, match="raw depth is 5 times the truth: are both in one unit"):
        datasets.Folder(tmp_path)["depth/a.png"]
    (tmp_path / "truth" / "a.npy").unlink()
    cv2.imwrite(str(tmp_path / "truth" / "a.png"), np.full((4, 6), 4000, np.uint16))
    assert np.allclose(datasets.Folder(tmp_path, depth_scale=0.0002)["depth/a.png"].depth_gt, 0.8)
