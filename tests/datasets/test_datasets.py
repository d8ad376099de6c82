import json
import pickle
import shutil
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

import ditr_lite as dl
from ditr_lite import datasets, files
from ditr_lite.camera import Camera
from ditr_lite.data import REFLECTIVE, TRANSPARENT, lossy
from ditr_lite.region import IGNORE

REAL = Path(__file__).resolve().parents[3] / "shared" / "real"
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason="no real frames beside the repository")
SHAPE = (12, 16)
REGION = np.zeros(SHAPE, bool)
REGION[4:8, 5:11] = True


def put(path, array):
    """Write an array in the format that the path's suffix names."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".exr":
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {c: array.copy() for c in "RGB"}).write(str(path))
    elif path.suffix == ".npy":
        np.save(path, array)
    else:
        path.write_bytes(cv2.imencode(path.suffix, array)[1].tobytes())


def raw_depth(seed=0):
    depth = np.random.default_rng(seed).uniform(0.4, 0.9, SHAPE).astype(np.float16)
    depth[:2] = 0
    return depth


def colour():
    return np.full((*SHAPE, 3), (20, 80, 200), np.uint8)  # as OpenCV writes it: blue first


def make_cleargrasp(root, stem="000000001"):
    truth = raw_depth(1)
    truth[3] = np.nan
    put(root / f"{stem}-transparent-rgb-img.jpg", colour())
    put(root / f"{stem}-transparent-depth-img.exr", raw_depth())
    put(root / f"{stem}-opaque-depth-img.exr", truth)
    put(root / f"{stem}-mask.png", REGION.astype(np.uint8) * 255)


def make_todd(root):
    instances = REGION.astype(np.uint8) * 20
    instances[-1] = 255
    put(root / "image.jpg", colour())
    put(root / "depth.exr", np.where(REGION, np.inf, raw_depth()).astype(np.float32))
    put(root / "detph_GroundTruth.exr", raw_depth(1).astype(np.float32))
    put(root / "instance_segment.png", np.dstack([0 * instances, 0 * instances, instances]))  # in the red channel


def make_std(root, stem="0000"):
    instances = np.full(SHAPE, 255, np.uint8)
    instances[4:8, 5:8], instances[4:8, 8:11], instances[9:, :4] = 0, 1, 2
    put(root / f"{stem}_color.png", colour())
    put(root / f"{stem}_depth_415.exr", raw_depth().astype(np.float32))
    put(root / f"{stem}_gt_depth.exr", raw_depth(1).astype(np.float32))
    put(root / f"{stem}_mask.png", instances)
    rows = ["0 1 folder glass 0.1 2 1 0 0 0 0.1 0.2 0.3", "1 4 3", "2 5 folder cup 0.1 1 1 0 0 0 0.1 0.2 0.3"]
    (root / f"{stem}_meta.txt").write_text("\n".join(rows) + "\n")


def make_trosd(root, stem="0001"):
    mask = np.zeros((*SHAPE, 3), np.uint8)
    mask[4:8, 5:8, 2] = 255  # red, as OpenCV writes it
    mask[4:8, 8:11, 1] = 255
    put(root / "rgb" / f"{stem}.jpg", colour())
    put(root / "depth" / f"{stem}.png", (raw_depth() * 1000).astype(np.uint16))
    put(root / "mask" / f"{stem}.png", mask)


def make_transcg(root):
    root.mkdir(parents=True, exist_ok=True)
    (root / "metadata.json").write_text(json.dumps({"total_scenes": 2, "train": [1], "test": [2]}))
    put(root / "camera_intrinsics" / "1-camIntrinsics-D435.npy", np.array([[92, 0, 7.2], [0, 88, 5.9], [0, 0, 1]]))
    for scene in ("scene1", "scene2"):
        for view in ("0", "1"):
            for k, units in (("1", 1000), ("2", 4000)):
                put(root / scene / view / f"rgb{k}.png", colour())
                put(root / scene / view / f"depth{k}.png", (raw_depth().astype(float) * units).astype(np.uint16))
                put(root / scene / view / f"depth{k}-gt.png", (raw_depth(1).astype(float) * units).astype(np.uint16))
                put(root / scene / view / f"depth{k}-gt-mask.png", REGION.astype(np.uint8))
        valid = {"D435_valid_perspective_list": [0, 1], "L515_valid_perspective_list": [1]}
        (root / scene / "metadata.json").write_text(json.dumps(valid))


MAKE = {  # dataset -> (reader, how to make a tree of two frames or more, one split and its names)
    "cleargrasp": (
        datasets.ClearGrasp,
        lambda r: [make_cleargrasp(r / s / "d435") for s in ("real-val", "real-test")],
        ("real-val", ["real-val/d435/000000001"]),
    ),
    "todd": (
        datasets.TODD,
        lambda r: [make_todd(r / "train" / "train" / "1622.5"), make_todd(r / "test" / "1623.5")],
        ("train", ["train/train/1622.5"]),
    ),
    "std": (
        datasets.STD,
        lambda r: [
            make_std(r / s) for s in ("STD-CatKnown/train_0", "STD-CatKnown/test_0", "STD-CatNovel/train_like_0")
        ],
        ("train", ["STD-CatKnown/train_0/0000"]),
    ),
    "trosd": (datasets.TROSD, lambda r: [make_trosd(r / s) for s in ("train", "test")], ("test", ["test/depth/0001"])),
    "transcg": (
        datasets.TransCG,
        make_transcg,
        ("test", ["scene2/0/depth1", "scene2/1/depth1", "scene2/1/depth2"]),
    ),
}


@pytest.mark.parametrize("name", MAKE)
def test_every_reader(tmp_path, name):
    reader, make, (split, names) = MAKE[name]
    make(tmp_path)
    frames = reader(tmp_path)
    assert datasets.REGISTRY[name] is reader
    assert len(frames) == len(frames.names) > len(names)
    assert reader(tmp_path, split).names == names
    for sample in frames:  # ends by itself
        assert sample.rgb.dtype == np.uint8 and sample.rgb.shape == (*SHAPE, 3)
        assert sample.rgb[0, 0, 0] > sample.rgb[0, 0, 2] + 100  # red first
        assert sample.depth.dtype == np.float32 and sample.depth.shape == SHAPE
        assert not sample.depth[:2].any() and np.isfinite(sample.depth).all()
        if name != "todd":  # where the glass reads infinite, hence missing
            np.testing.assert_allclose(sample.depth, raw_depth(), atol=1.1e-3)
        else:
            assert not sample.depth[REGION].any()
        np.testing.assert_array_equal(sample.region, REGION)
        np.testing.assert_array_equal(lossy(sample.material), REGION)
        if name == "trosd":
            assert sample.depth_gt is None
        else:
            kept = np.ones(SHAPE, bool)
            kept[{"cleargrasp": 3, "todd": -1}.get(name, 0)] = False
            np.testing.assert_allclose(sample.depth_gt[kept], raw_depth(1)[kept], atol=1.1e-3)
            assert not sample.depth_gt[~kept].any() and sample.depth_gt.dtype == np.float32
    again = pickle.loads(pickle.dumps(frames))
    assert again.names == frames.names and again[frames.names[-1]].name == frames.names[-1]


@pytest.mark.parametrize("name", MAKE)
def test_hidden_files_are_no_frames(tmp_path, name):
    reader, make, _ = MAKE[name]
    make(tmp_path / "seen")
    names = reader(tmp_path / "seen").names
    for path in [path for path in (tmp_path / "seen").rglob("*") if path.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(b"\x00\x05\x16\x07")  # as macOS leaves them
    shutil.copytree(tmp_path / "seen", tmp_path / "seen" / ".Trash-1000")
    assert reader(tmp_path / "seen").names == names


@pytest.mark.parametrize("name", MAKE)
def test_a_wrong_root_or_split_is_explained(tmp_path, name):
    reader, make, _ = MAKE[name]
    with pytest.raises(ValueError, match=f"no {reader.__name__} frames in .*expected .*(depth|NNN)"):
        reader(tmp_path)
    with pytest.raises(ValueError, match="no .* frames of split"):
        reader(tmp_path / "absent", reader.splits[0])
    with pytest.raises(ValueError, match="unknown split 'all'"):
        reader(tmp_path, "all")
    make(tmp_path)
    with pytest.raises(ValueError, match="no frame called 'x'"):
        reader(tmp_path)["x"]
    with pytest.raises(IndexError):
        reader(tmp_path)[99]


def test_materials_of_std_and_trosd(tmp_path):
    make_std(tmp_path / "std" / "STD-CatNovel" / "a")
    make_trosd(tmp_path / "trosd" / "train")
    for frames in (datasets.STD(tmp_path / "std", "novel"), datasets.TROSD(tmp_path / "trosd")):
        material = frames[0].material
        assert (material[4:8, 5:8] == TRANSPARENT).all() and (material[4:8, 8:11] == REFLECTIVE).all()
    instances = datasets.STD(tmp_path / "std")[0].instances
    assert set(np.unique(instances)) == {0, 1, 2, 3}


def test_faint_colours_of_a_mask_of_trosd_are_no_material(tmp_path):
    make_trosd(tmp_path / "train")
    path = tmp_path / "train" / "mask" / "0001.png"
    mask = cv2.imread(str(path))
    mask[0, 0], mask[0, 1], mask[0, 2], mask[0, 3] = (0, 0, 127), (0, 127, 0), (0, 0, 128), (0, 128, 0)
    put(path, mask)
    material = datasets.TROSD(tmp_path)[0].material
    assert material[0, :5].tolist() == [0, 0, TRANSPARENT, REFLECTIVE, 0]


def test_cleargrasp_takes_a_flat_folder_and_does_without_truth(tmp_path):
    make_cleargrasp(tmp_path)
    (tmp_path / "camera_intrinsics.yaml").write_text("xres: 16\nyres: 12\nfx: 92\nfy: 88\ncx: 7.2\ncy: 5.9\n")
    frames = datasets.ClearGrasp(tmp_path)
    assert frames.names == ["000000001"]
    assert frames[0].camera == Camera(92.0, 88.0, 7.2, 5.9, 16, 12)
    (tmp_path / "000000001-opaque-depth-img.exr").unlink()
    (tmp_path / "000000001-mask.png").unlink()
    sample = frames[0]
    assert sample.depth_gt is None and sample.region is None and sample.material is None
    put(tmp_path / "000000001-mask.png", np.zeros((6, 8), np.uint8))
    with pytest.raises(ValueError, match=r"region is \(6, 8\)"):
        frames[0]
    (tmp_path / "000000001-transparent-rgb-img.jpg").unlink()
    with pytest.raises(ValueError, match="no file .*rgb-img.jpg"):
        frames[0]


def test_a_folder_inside_the_dataset_knows_its_split(tmp_path):
    make_cleargrasp(tmp_path / "real-val" / "d435")
    inside = tmp_path / "real-val" / "d435"
    assert len(datasets.ClearGrasp(inside, "real-val")) == 1
    with pytest.raises(ValueError, match="no ClearGrasp frames of split 'real-test'"):
        datasets.ClearGrasp(inside, "real-test")


SYNTHETIC = "depth-imgs-rectified/0-depth-rectified.exr"
STD_FILES = [f"{scene}/0000_depth_415.exr" for scene in ("STD-CatKnown/train_0", "STD-CatKnown/test_0")]
STD_FILES += ["STD-CatNovel/train_like_0/0000_depth_415.exr"]


@pytest.mark.parametrize(
    ("reader", "above", "files", "split", "names"),
    [
        (datasets.TODD, "test/TODD", ["train/1/depth.exr", "test/2/depth.exr"], "test", ["test/2"]),
        (datasets.TROSD, "test/TROSD", ["train/depth/1.png", "test/depth/2.png"], "test", ["test/depth/2"]),
        (
            datasets.ClearGraspSynthetic,
            "my-train/cg",
            [f"cup-train/{SYNTHETIC}", f"cup-val/{SYNTHETIC}"],
            "train",
            ["cup-train/depth-imgs-rectified/0"],
        ),
        (
            datasets.ClearGraspSynthetic,
            "cg",
            [f"all-test-val/all-{split}/cup-{split}/{SYNTHETIC}" for split in ("val", "test")],
            "val",
            ["all-test-val/all-val/cup-val/depth-imgs-rectified/0"],
        ),
        (datasets.STD, "train_data/STD", STD_FILES, "train", ["STD-CatKnown/train_0/0000"]),
        (datasets.STD, "STD-CatNovel/STD", STD_FILES, "novel", ["STD-CatNovel/train_like_0/0000"]),
        (datasets.STD, "STD-CatNovel/STD", STD_FILES, "test", ["STD-CatKnown/test_0/0000"]),
    ],
)
def test_folders_above_a_dataset_do_not_name_its_splits(tmp_path, reader, above, files, split, names):
    for file in files:
        (tmp_path / above / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / above / file).touch()
    assert reader(tmp_path / above, split).names == names
    inside = (tmp_path / above / names[0]).parent  # which any folder of the dataset may be
    if reader is not datasets.TODD:
        assert len(reader(inside if reader is datasets.STD else inside.parent, split)) == 1


def test_transcg_reads_the_camera_it_has(tmp_path):
    make_transcg(tmp_path)
    frames = datasets.TransCG(tmp_path)
    assert frames["scene1/0/depth1"].camera == Camera(92.0, 88.0, 7.2, 5.9, 16, 12)
    assert frames["scene1/1/depth2"].camera is None  # its file is not there
    (tmp_path / "scene2" / "metadata.json").unlink()
    with pytest.raises(ValueError, match="no file .*scene2"):
        datasets.TransCG(tmp_path)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{}", r"scene1.metadata.json should list the views under 'D435_valid_perspective_list', got None"),
        ("[]", r"scene1.metadata.json should hold a JSON object, got list"),
        ("{", r"cannot read .*scene1.metadata.json as JSON"),
    ],
)
def test_transcg_names_metadata_that_is_no_use(tmp_path, text, reason):
    make_transcg(tmp_path)
    (tmp_path / "scene1" / "metadata.json").write_text(text)
    with pytest.raises(ValueError, match=reason):
        datasets.TransCG(tmp_path)


def test_transcg_without_a_valid_view_is_refused(tmp_path):
    make_transcg(tmp_path)
    none = {"D435_valid_perspective_list": [], "L515_valid_perspective_list": []}
    for scene in ("scene1", "scene2"):
        (tmp_path / scene / "metadata.json").write_text(json.dumps(none))
    with pytest.raises(ValueError, match=r"no valid view in .*scene\*/metadata.json"):
        datasets.TransCG(tmp_path)


@pytest.mark.parametrize("split", [None, "test"])
def test_transcg_needs_its_own_root(tmp_path, split):
    make_transcg(tmp_path / "transcg")
    with pytest.raises(ValueError, match="no TransCG frames .*expected metadata.json"):
        datasets.TransCG(tmp_path, split)
    (tmp_path / "transcg" / "scene1").rename(tmp_path / "transcg" / "scene1_old")
    assert {name.split("/")[0] for name in datasets.TransCG(tmp_path / "transcg").names} == {"scene2"}


@pytest.mark.parametrize("line", ["0 1", "0 1 glass", "a 1 2"])
def test_a_row_of_std_that_is_no_use_is_named(tmp_path, line):
    make_std(tmp_path / "train_0")
    (tmp_path / "train_0" / "0000_meta.txt").write_text(f"1 4 3\n\n{line}\n")
    with pytest.raises(ValueError, match=f"0000_meta.txt, line 3: expected .*got '{line}'"):
        datasets.STD(tmp_path)[0]


@needs_real
@pytest.mark.parametrize(
    ("name", "missing", "region", "missing_in_region", "bias_m"),
    [("000000080", 0.136, 0.134, 0.49, 0.050), ("000000123", 0.237, 0.030, 0.29, 0.015)],
)
def test_real_cleargrasp_frames_are_as_documented(name, missing, region, missing_in_region, bias_m):
    sample = datasets.ClearGrasp(REAL / "cleargrasp_d435")[name]
    assert sample.rgb.shape == (720, 1280, 3) and sample.camera == Camera(921.0, 921.0, 642.0, 359.0, 1280, 720)
    assert np.isclose((sample.depth == 0).mean(), missing, atol=6e-4)
    assert np.isclose(sample.region.mean(), region, atol=6e-4)
    assert np.isclose((sample.depth[sample.region] == 0).mean(), missing_in_region, atol=0.006)
    both = sample.region & (sample.depth > 0) & (sample.depth_gt > 0)
    assert np.isclose((sample.depth - sample.depth_gt)[both].mean(), bias_m, atol=0.0015)


@needs_real
def test_real_frames_of_other_cameras():
    folder = REAL / "lingbot" / "2"
    rgb, depth = files.read_rgb(folder / "rgb.png"), files.read_depth(folder / "raw_depth.png")
    own = files.read_intrinsics(folder / "intrinsics.txt", rgb.shape[:2])
    assert rgb.shape == (480, 640, 3) and depth.shape == (480, 640) and 0.1 < depth[depth > 0].min() < depth.max() < 2
    assert np.isclose(own.fx, 460.14, atol=0.01) and (own.width, own.height) == (640, 480)
    folder = REAL / "dsikar_d415"
    assert files.read_rgb(folder / "d415_color_img.npy").shape == (720, 1280, 3)
    assert np.isclose((files.read_depth(folder / "d415_input_depth.npy") == 0).mean(), 0.16, atol=0.005)


def test_what_todd_asks_to_ignore_is_neither_glass_nor_opaque(tmp_path):
    make_todd(tmp_path / "train" / "train" / "1622.5")
    sample = datasets.TODD(tmp_path, "train")[0]
    assert (sample.material[-1] == IGNORE).all() and not sample.region[-1].any() and not sample.depth_gt[-1].any()
    assert (sample.camera.width, sample.camera.height) == SHAPE[::-1]
    dl.save_sample(sample, tmp_path / "kept")
    assert np.array_equal(dl.read_sample(tmp_path / "kept").region, sample.region)
