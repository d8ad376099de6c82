"""What STD and DREDS leave to their reader: the camera, and what true depth is called."""

import cv2
import numpy as np
import pytest

from ditr_lite import datasets, files

MAPS = {"STD": ("depth_415", "gt_depth"), "DREDS": ("simDepthImage", "depth_120")}


def write_frame(root, name, suffixes, shape):
    folder = root / f"{name}-CatKnown" / "train" / "0"
    folder.mkdir(parents=True)
    cv2.imwrite(str(folder / "0000_color.png"), np.zeros((*shape, 3), np.uint8))
    for suffix in suffixes:
        files.write_exr(folder / f"0000_{suffix}.exr", {"R": np.full(shape, 0.6, np.float32)})
    files.write_exr(folder / "0000_mask.exr", {"R": np.ones(shape, np.float32)})
    cv2.imwrite(str(folder / "0000_mask.png"), np.full(shape, 255, np.uint8))
    (folder / "0000_meta.txt").write_text("")


@pytest.mark.parametrize(("name", "suffixes"), MAPS.items())
@pytest.mark.parametrize("width", [320, 640, 1280])
def test_the_focal_length_follows_the_width_of_the_picture(tmp_path, name, suffixes, width):
    shape = (width * 9 // 16, width)
    write_frame(tmp_path, name, suffixes, shape)
    reader = getattr(datasets, name)
    camera = reader(tmp_path)[0].camera
    fx, fy, wide = reader.focal
    assert (camera.fx / width, camera.fy / width) == pytest.approx((fx / wide, fy / wide))
    assert (camera.cx, camera.cy, camera.width, camera.height) == (width / 2 - 0.5, shape[0] / 2 - 0.5, width, shape[0])


def test_true_depth_of_dreds_has_two_names(tmp_path):
    write_frame(tmp_path, "DREDS", ("simDepthImage", "depth_0"), (18, 32))
    frames = datasets.DREDS(tmp_path)
    assert frames[0].depth_gt.max() == np.float32(0.6)
    assert all(path.is_file() for path in frames.files(frames.names)[0])
