"""Every reader reads what the exporter of the same name wrote: the formats, by a round trip over our own scenes."""

import json
import pickle
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from torch.utils.data import DataLoader

from ditr_lite import datasets, files
from ditr_lite.camera import Camera
from ditr_lite.cli import main
from ditr_lite.data import Sample, list_samples, load_sample
from ditr_lite.datasets import export

SCENES = [load_sample(name) for name in list_samples("val")[:3]]
STEP_M = {"cleargrasp": 1e-3, "trosd": 5.1e-4, "transcg": 5.1e-4, "folder": 5.1e-4}  # half floats, millimetres
THEIRS = {  # dataset -> the split that our val split becomes, files that one frame must have
    "cleargrasp": (
        "real-val",
        ["real-val/d435/000000000-transparent-depth-img.exr", "real-val/d435/000000000-mask.png"],
    ),
    "cleargrasp_synthetic": ("val", ["table-top-val/outlines/000000000-outlineSegmentation.png"]),
    "todd": ("val", ["val/1622500000.0/detph_GroundTruth.exr", "val/1622500000.0/pose_type.json"]),
    "std": ("test", ["STD-CatKnown/test_0/0000_depth_415.exr", "STD-CatKnown/test_0/0000_meta.txt"]),
    "dreds": ("val", ["DREDS-CatKnown/val/0/0000_simDepthImage.exr", "DREDS-CatKnown/val/0/0000_mask.exr"]),
    "trosd": ("test", ["test/rgb/000000.jpg", "test/depth/000000.png", "test.txt"]),
    "transcg": ("test", ["metadata.json", "scene1/0/depth2-gt-mask.png", "camera_intrinsics/2-camIntrinsics-L515.npy"]),
    "folder": (None, ["intrinsics.npy", "rgb/val_00000.png", "truth/val_00000.png"]),
}


def test_every_reader_has_a_writer_and_a_case():
    assert set(export.WRITERS) == set(datasets.REGISTRY) == set(THEIRS)


@pytest.fixture(scope="module", params=THEIRS)
def exported(request, tmp_path_factory):
    root = tmp_path_factory.mktemp(request.param) / "new"
    return request.param, export.export(request.param, root, SCENES, "val")


def test_the_layout_is_the_datasets_own(exported):
    name, root = exported
    for path in THEIRS[name][1]:
        assert (root / path).is_file(), sorted(p.relative_to(root).as_posix() for p in root.rglob("*") if p.is_file())
    assert not list(root.rglob("*.part*"))


def test_a_round_trip_keeps_all_that_the_format_holds(exported):
    name, root = exported
    frames = datasets.REGISTRY[name](root, THEIRS[name][0])
    per_scene = 2 if name == "transcg" else 1
    assert len(frames) == per_scene * len(SCENES)
    for k, got in enumerate(frames):
        scene = SCENES[k // per_scene]
        step = STEP_M.get(name, 1e-6)
        raw = np.where(scene.region, 0, scene.depth_gt) if name == "cleargrasp_synthetic" else scene.depth
        np.testing.assert_allclose(got.depth, raw, atol=step)
        np.testing.assert_array_equal(got.depth == 0, raw == 0)
        np.testing.assert_array_equal(got.region, scene.region)
        if name == "trosd":
            assert got.depth_gt is None
        else:
            np.testing.assert_allclose(got.depth_gt, scene.depth_gt, atol=step)
        if name in ("std", "dreds", "trosd"):  # the formats that tell glass from metal
            np.testing.assert_array_equal(got.material, scene.material)
        assert np.abs(got.rgb.astype(int) - scene.rgb).mean() < (
            3 if name in ("todd", "trosd") or "clear" in name else 0.01
        )
        own = name == "cleargrasp_synthetic" or (k == 0 and name in ("cleargrasp", "transcg", "folder"))
        if own:  # one camera for all frames; STD, DREDS and TODD do not even have a file for it
            assert np.isclose(got.camera.fx, scene.camera.fx) and np.isclose(got.camera.cx, scene.camera.cx)
            assert (got.camera.width, got.camera.height) == (256, 192)


def count(batch):
    return [(sample.name, int((sample.depth > 0).sum())) for sample in batch]


def test_readers_work_in_the_processes_of_a_data_loader(exported):
    name, root = exported
    frames = datasets.REGISTRY[name](root)
    assert pickle.loads(pickle.dumps(frames)).names == frames.names
    if name == "cleargrasp":  # one that really starts processes, so that the test stays quick
        loader = DataLoader(frames, batch_size=2, num_workers=1, collate_fn=count, multiprocessing_context="spawn")
        assert [row for batch in loader for row in batch] == count(frames)


def test_listing_reads_no_picture(exported, monkeypatch):
    name, root = exported

    def refuse(*_):
        raise AssertionError("a file was opened")

    monkeypatch.setattr(cv2, "imdecode", refuse)
    monkeypatch.setattr(files.OpenEXR, "File", refuse)
    frames = datasets.REGISTRY[name](root)
    assert len(frames) >= 3
    with pytest.raises(AssertionError, match="opened"):
        frames[0]


def test_the_command_writes_what_evaluate_reads(tmp_path, capsys):
    out = tmp_path / "todd"
    assert main(["simulate", "--export-as", "todd", str(out), "--count", "2"]) == 0
    said = capsys.readouterr().out
    assert f"2 frames; read them with `evaluate --dataset todd --root {out}`" in said
    assert len(datasets.TODD(out, "val")) == 2
    assert main(["simulate", "--export-as", "trosd", str(tmp_path / "trosd"), "--count", "2"]) == 0
    assert "2 frames; they hold no true depth, so `evaluate` has nothing to score" in capsys.readouterr().out
    for argv, reason in (
        (["--export-as", "todd", str(out)], "not an empty folder"),
        (["--export-as", "nyu", str(tmp_path / "x")], "cannot export as 'nyu'; choose one of cleargrasp"),
        (["--root", str(tmp_path)], "--root is where --export-as takes its scenes from"),
    ):
        assert main(["simulate", *argv]) == 2
        assert reason in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("name", THEIRS)
@pytest.mark.parametrize(("rooms", "ours"), [("rooms_train", "train"), ("rooms_val", "val"), ("rooms", "test")])
def test_rooms_go_where_table_tops_of_like_use_go(tmp_path, name, rooms, ours):
    one, two = (export.export(name, tmp_path / split, SCENES[:1], split) for split in (rooms, ours))
    lists = [sorted(p.relative_to(root).as_posix() for p in root.rglob("*")) for root in (one, two)]
    assert lists[0] == lists[1]


def test_a_folder_that_is_itself_a_frame_holds_none(tmp_path):
    root = export.export("todd", tmp_path / "new", SCENES[:1], "val")
    with pytest.raises(ValueError, match="no TODD frames"):
        datasets.REGISTRY["todd"](root / "val" / "1622500000.0")


def test_a_frame_without_truth_cannot_be_exported(tmp_path):
    bare = Sample("x", np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), np.float32))
    with pytest.raises(ValueError, match="x lacks ground truth"):
        export.export("std", tmp_path / "new", [bare])


def test_more_things_than_todd_can_number_are_refused(tmp_path):
    def row_of(count):
        things = np.tile(np.arange(1, count + 1, dtype=np.uint8), (4, 1))
        depth, rgb = np.full(things.shape, 0.5, np.float32), np.full((*things.shape, 3), 90, np.uint8)
        camera = Camera(9, 9, 3.5, 1.5, count, 4)
        return Sample("x", rgb, depth, depth, things > 0, camera, np.ones_like(things), things)

    [got] = datasets.TODD(export.export("todd", tmp_path / "r", [row_of(25)], "train"))
    assert got.region.all() and np.array_equal(got.instances, row_of(25).instances)
    with pytest.raises(
        ValueError, match="x has 26 transparent or reflective things, TODD room for 25: export as another"
    ):
        export.export("todd", tmp_path / "s", [row_of(26)], "train")


@pytest.mark.parametrize("exists", [False, True])
def test_a_failed_export_leaves_nothing_and_can_be_repeated(tmp_path, exists):
    root, bare = tmp_path / "new", Sample("x", SCENES[0].rgb, SCENES[0].depth)
    if exists:
        root.mkdir()
    with pytest.raises(ValueError, match="x lacks ground truth"):
        export.export("todd", root, [SCENES[0], bare])
    assert [p for p in tmp_path.rglob("*") if p != root] == [] and root.exists() == exists
    assert len(datasets.TODD(export.export("todd", root, SCENES[:1]))) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["new"]


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    depth=hnp.arrays(np.float32, (6, 8), elements=st.just(0.0) | st.floats(0.0625, 60, width=32)),
    material=hnp.arrays(np.uint8, (6, 8), elements=st.integers(0, 2)),
    name=st.sampled_from(["std", "dreds", "todd"]),
)
def test_any_depth_and_any_mask_survive(tmp_path_factory, depth, material, name):
    depth[0, 0] = 0.5  # truth must hold something
    rgb = np.full((6, 8, 3), 90, np.uint8)
    sample = Sample("x", rgb, depth, depth, material > 0, Camera(9, 9, 3.5, 2.5, 8, 6), material, material)
    root = export.export(name, tmp_path_factory.mktemp("p") / "r", [sample], "train")
    got = datasets.REGISTRY[name](root, "train")[0]
    np.testing.assert_array_equal(got.depth, depth)
    np.testing.assert_array_equal(got.depth_gt, depth)
    np.testing.assert_array_equal(got.region, material > 0)


def test_synthetic_cleargrasp_takes_its_camera_from_the_json_or_the_known_one(tmp_path):
    root = export.export("cleargrasp_synthetic", tmp_path / "r", SCENES[:1], "val")
    frames = datasets.ClearGraspSynthetic(root)
    (described,) = root.rglob("*-masks.json")
    for content in (json.dumps({"variants": []}), "[]", "not json"):
        described.write_text(content)
        assert np.isclose(frames[0].camera.fx, 256 / 2 / np.tan(1.21126 / 2), rtol=1e-4)
    for angle in (0, -1, 4, float("nan")):
        described.write_text(json.dumps({"camera": {"field_of_view": {"x_axis_rads": angle, "y_axis_rads": 0.7}}}))
        with pytest.raises(ValueError, match="field of view between 0 and pi"):
            frames[0]
    described.unlink()
    assert np.isclose(frames[0].camera.fy, 192 / 2 / np.tan(0.74283 / 2), rtol=1e-4)


def test_trosd_goes_by_its_lists_where_there_are_any(tmp_path):
    root = export.export("trosd", tmp_path / "r", SCENES, "val")
    (root / "test_glass.txt").write_text("test/rgb/000002.jpg test/mask/000002.png\n\n")
    (root / "test.txt").unlink()
    assert datasets.TROSD(root, "test").names == ["test/depth/000002"]
    assert len(datasets.TROSD(root)) == 3
    with pytest.raises(ValueError, match="no TROSD frames of split 'train'"):
        datasets.TROSD(root, "train")


def test_trosd_tells_frames_of_one_name_apart_by_the_folder_that_a_list_gives(tmp_path):
    root = tmp_path / "r"
    export.export("trosd", root, SCENES[:1], "test")
    shutil.copytree(root / "test", root / "train")
    for split in ("train", "test"):
        (root / f"{split}.txt").write_text(f"TROSD/{split}/rgb/000000.jpg\n")
        assert datasets.TROSD(root, split).names == [f"{split}/depth/000000"]
    for row in ("rgb/000000.jpg", "000000", "train/rgb/000000.jpg\ntest/rgb/000000.jpg"):
        (root / "test.txt").write_text(row)
        assert datasets.TROSD(root, "test").names == ["test/depth/000000", "train/depth/000000"]
    (root / "test" / "test.txt").write_text("test/rgb/000000.jpg")
    assert datasets.TROSD(root / "test", "test").names == ["depth/000000"]


def test_what_can_be_taught_where():
    scene = SCENES[0]
    masks = datasets.teachable(scene)
    assert not (masks["optical"] & masks["geometric"]).any()
    assert (masks["optical"] == (scene.region & (scene.depth_gt > 0))).all()
    holes = masks["geometric"]
    assert holes.any() and (scene.depth[holes] == 0).all() and not scene.region[holes].any()
    synthetic = Sample("s", scene.rgb, np.where(scene.region, 0, scene.depth_gt), scene.depth_gt, scene.region)
    assert not datasets.teachable(synthetic)["geometric"].any()  # nothing is missing outside: nothing to learn there
    bare = Sample("b", scene.rgb, scene.depth)
    assert not any(mask.any() for mask in datasets.teachable(bare).values())


def test_every_reader_says_how_the_paper_uses_its_dataset():
    assert all(len(reader.protocol) > 60 for reader in datasets.REGISTRY.values())


def test_a_folder_of_your_own_needs_only_two_files_a_frame(tmp_path):
    files_ = {"rgb/a.jpg": SCENES[0].rgb, "depth/a.png": (SCENES[0].depth * 10000).astype(np.uint16)}
    for name, array in files_.items():
        (tmp_path / name).parent.mkdir()
        cv2.imwrite(str(tmp_path / name), array)
    (tmp_path / "depth" / "notes.md").write_text("not a frame")
    frames = datasets.Folder(tmp_path, depth_scale=1e-4)
    assert frames.names == ["depth/a.png"]
    sample = frames[0]
    np.testing.assert_allclose(sample.depth, SCENES[0].depth, atol=1.1e-4)
    assert sample.region is None and sample.camera is None and sample.depth_gt is None
    (tmp_path / "rgb" / "a.jpg").unlink()
    with pytest.raises(ValueError, match="no colour picture for a in"):
        datasets.Folder(tmp_path, depth_scale=1e-4)[0]


def test_a_folder_of_many_frames_is_listed_once(tmp_path, monkeypatch):
    for i in range(4):
        for kind, array in (("rgb", SCENES[0].rgb), ("depth", (SCENES[0].depth * 1000).astype(np.uint16))):
            (tmp_path / kind).mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / kind / f"{i}.png"), array)
    frames, listed = datasets.Folder(tmp_path), []
    listing = Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda path: listed.append(path.name) or listing(path))
    assert len(list(frames)) == 4 and listed.count("rgb") == 1


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("metadata.json", '{"train": 3, "test": [1]}'),
        ("metadata.json", "[]"),
        ("metadata.json", "\xff"),
        ("scene1/metadata.json", "{}"),
        ("scene1/metadata.json", '{"D435_valid_perspective_list": "all"}'),
        ("scene1/metadata.json", "not json"),
    ],
)
def test_odd_descriptions_of_transcg_are_named(tmp_path, name, content):
    root = export.export("transcg", tmp_path / "r", SCENES[:1], "train")
    (root / name).write_text(content, encoding="latin-1")
    with pytest.raises(ValueError, match=name) as refusal:
        datasets.TransCG(root, "train")[0]
    assert "\n" not in str(refusal.value)
