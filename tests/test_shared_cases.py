"""Files as people had them, made from a shipped scene, where the scripts that make them lie beside the repository."""

import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from ditr_lite import data, datasets, files

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = ROOT.parent / "shared" / "cases"
pytestmark = pytest.mark.skipif(not SCRIPTS.is_dir(), reason="no scripts that make cases beside the repository")

DEPTH = {  # file -> scale, and the reason of refusal; None for depth that comes back as the scene's
    "float_scale/depth_mm.npy": (0.001, None),
    "float_scale/depth_cm.npy": (0.01, None),
    "float_scale/depth_dm.npy": (0.1, None),
    "float_scale/depth_tenth_mm.npy": (0.0001, None),
    "float_scale/depth_mm.tif": (0.001, None),
    "containers/D.NPY": (None, None),
    "containers/D.PNG": (None, None),
    "containers/Z.EXR": (None, None),
    "containers/be.npy": (None, None),
    "containers/bef.npy": (None, None),
    "containers/blender.exr": (None, None),
    "containers/d.pgm": (None, None),
    "containers/d16.tif": (None, None),
    "containers/d16_be.tif": (None, None),
    "containers/d16_zlib.tif": (None, None),
    "containers/d32m.tiff": (None, None),
    "containers/f64.npy": (None, None),
    "containers/four.png": (None, None),
    "containers/three.png": (None, None),
    "containers/hw1.npy": (None, None),
    "containers/i16.npy": (None, None),
    "containers/i32neg.npy": (None, None),
    "containers/kinect_pgm_maxval2047.pgm": (None, None),
    "containers/rgbz.exr": (None, None),
    "containers/ros_compressedDepth.png": (None, None),
    "containers/y.exr": (None, None),
    "float_scale/depth_cm.npy ": (None, r"centimetres\? pass depth_scale=0.01"),
    "float_scale/depth_mm.npy ": (None, r"millimetres\? pass depth_scale=0.001"),
    "blended_border/up_mm_float.npy": (None, r"values up to 97\d.*depth_scale=0.001"),
    "blended_border/half_mm_float.npy": (None, "depth_scale=0.001"),
    "containers/swapped.png": (None, "two bytes swapped"),
    "containers/d16_planes.tif": (None, "holds 2 pictures"),
    "containers/chw.npy": (None, "one depth channel"),
    "containers/obj.npy": (None, "Python objects"),
    "containers/d.npz": (None, "cannot read"),
    "containers/d8.jpg": (None, "8 bits a pixel"),
    "truncated/depth_flip.png": (None, "cannot read"),
    **{f"truncated/depth_cut{s}.{e}": (None, "cannot read") for s in (30, 60, 90) for e in ("png", "tif", "npy")},
}
MASKS = ("grey255", "grey01", "palette01", "palette_bw", "onebit", "la", "rgba_opaque", "alpha_cutout", "u16")
FOLDERS = ("mm", "mac", "tif", "upper", "upper_depth", "tum5000", "quarter", "float_mm", "no_region")
SCALES = {"tum5000": 0.0002, "quarter": 0.00025, "float_mm": 0.001}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    for script in ("make_files.py", "make_folders.py"):
        subprocess.run([sys.executable, SCRIPTS / script, folder], cwd=ROOT, check=True, capture_output=True)
    return folder


@pytest.fixture(scope="module")
def scene():
    return data.load_sample("test_00003")


@pytest.mark.parametrize("name", DEPTH)
def test_depth_of_a_case(made, scene, name):
    scale, reason = DEPTH[name]
    path = made / name.strip()
    if reason is None:
        np.testing.assert_allclose(files.read_depth(path, scale), scene.depth, atol=1e-4)
    else:
        with pytest.raises(ValueError, match=reason):
            files.read_depth(path, scale)


@pytest.mark.parametrize("name", MASKS)
def test_mask_of_a_case(made, scene, name):
    np.testing.assert_array_equal(files.read_mask(made / "masks" / f"{name}.png"), scene.region)


@pytest.mark.parametrize("turn", [3, 6, 8])
def test_a_picture_of_a_phone_is_turned(made, scene, turn):
    with pytest.warns(UserWarning, match="EXIF orientation"):
        turned = files.read_rgb(made / "exif" / f"rgb_o{turn}.png")
    np.testing.assert_array_equal(turned, scene.rgb)


@pytest.mark.parametrize("name", FOLDERS)
def test_a_folder_of_a_case_reads_as_the_plain_one(made, name):
    plain = datasets.Folder(made / "folder_mm")
    frames = datasets.Folder(made / f"folder_{name}", depth_scale=SCALES.get(name))
    assert len(frames) == len(plain) == 3
    for one, other in zip(frames, plain, strict=True):
        np.testing.assert_allclose(one.depth, other.depth, atol=1e-4)
        np.testing.assert_allclose(one.depth_gt, other.depth_gt, atol=1e-4)


@pytest.mark.parametrize("name", ["damaged", "prefix", "stamps"])
def test_a_folder_that_cannot_be_read_says_why(made, name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(ValueError, match="cannot read|no colour picture for"):
            list(datasets.Folder(made / f"folder_{name}"))
