from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ditr_lite import data, units
from ditr_lite.camera import Camera, Stereo
from ditr_lite.data import Sample


def make_sample(name="test_0001", seed=0):
    rng = np.random.default_rng(seed)
    camera = Camera(300.0, 301.0, 15.5, 11.5, 32, 24)
    motion = ((1.0, 0.0, 0.0, 0.015), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    depth = rng.integers(300, 1200, (24, 32)).astype(np.float32) / np.float32(1000)
    depth[3:6, 4:9] = 0
    material = rng.integers(0, 3, (24, 32), dtype=np.uint8)
    return Sample(
        name=name,
        rgb=np.full((24, 32, 3), (200, 90, 30), np.uint8),
        depth=depth,
        depth_gt=depth + np.float32(0.25),
        region=material > 0,
        camera=camera,
        material=material,
        instances=rng.integers(0, 9, (24, 32), dtype=np.uint8),
        loss=rng.integers(0, 6, (24, 32), dtype=np.uint8),
        cause=rng.integers(0, 9, (24, 32), dtype=np.uint8),
        ir_left=rng.integers(0, 256, (20, 30), dtype=np.uint8),
        ir_right=rng.integers(0, 256, (20, 30), dtype=np.uint8),
        stereo=Stereo(camera, 0.05, motion),
        meta={"seed": 7, "sensor": {"block": 7}},
    )


def assert_same(a, b, but=()):
    for key in Sample.__dataclass_fields__:
        one, two = getattr(a, key), getattr(b, key)
        if key in but:
            continue
        if isinstance(one, np.ndarray):
            assert one.dtype == two.dtype and one.shape == two.shape, key
            np.testing.assert_allclose(one, two, atol=1e-6 if one.dtype == np.float32 else 0, err_msg=key)
        else:
            assert one == two, key


def test_a_sample_survives_the_disk(tmp_path):
    sample = make_sample()
    data.save_sample(sample, tmp_path / sample.name)
    again = data.read_sample(tmp_path / sample.name)
    assert_same(sample, again, but=("rgb",))
    # colour goes through JPEG: close, and red did not become blue
    assert np.abs(again.rgb.astype(int) - sample.rgb).max() <= 6
    assert again.rgb[0, 0, 0] > again.rgb[0, 0, 2] + 100
    assert again.stereo.motion().shape == (4, 4)


def test_a_sample_of_rgb_and_depth_only(tmp_path):
    full = make_sample()
    bare = Sample(name="test_0002", rgb=full.rgb, depth=full.depth)
    data.save_sample(bare, tmp_path / bare.name)
    again = data.read_sample(tmp_path / bare.name)
    assert_same(bare, again, but=("rgb",))
    assert again.depth_gt is None and again.region is None and again.camera is None


def test_a_region_without_material_comes_back_too(tmp_path):
    sample = replace(make_sample(), material=None)
    data.save_sample(sample, tmp_path / sample.name)
    assert_same(sample, data.read_sample(tmp_path / sample.name), but=("rgb",))
    with pytest.raises(ValueError, match="region and material disagree"):
        data.save_sample(replace(make_sample(), region=~sample.region), tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_saving_again_replaces_everything(tmp_path):
    folder = tmp_path / "test_0001"
    data.save_sample(make_sample(), folder)
    data.save_sample(replace(make_sample(), depth_gt=None), folder)
    assert data.read_sample(folder).depth_gt is None
    assert [p.name for p in tmp_path.iterdir()] == ["test_0001"]  # no temporary folder stays behind


def test_an_interrupted_save_leaves_the_old_sample(tmp_path, monkeypatch):
    folder = tmp_path / "test_0001"
    data.save_sample(make_sample(), folder)

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(cv2, "imencode", fail)
    with pytest.raises(OSError, match="disk full"):
        data.save_sample(make_sample(seed=1), folder)
    assert_same(make_sample(), data.read_sample(folder), but=("rgb",))


def test_listing_and_loading(tmp_path):
    for name in ("test_0002", "test_0001", "val_0001"):
        split = name.split("_")[0]
        (tmp_path / split).mkdir(exist_ok=True)
        data.save_sample(make_sample(name), tmp_path / split / name)
    (tmp_path / "test" / "test_0003.part").mkdir()
    (tmp_path / "test" / "test_0003.part" / "meta.json").write_text("{}")
    assert data.list_samples("test", tmp_path) == ["test_0001", "test_0002"]
    assert data.list_samples("val", tmp_path) == ["val_0001"]
    assert data.load_sample("val_0001", tmp_path).name == "val_0001"
    with pytest.raises(ValueError, match="no samples in"):
        data.list_samples("train", tmp_path)
    with pytest.raises(ValueError, match="train, val, test"):
        data.list_samples("all", tmp_path)
    with pytest.raises(ValueError, match="no sample called 'test_9999'"):
        data.load_sample("test_9999", tmp_path)


def test_reading_names_what_is_wrong(tmp_path):
    with pytest.raises(ValueError, match="expected rgb.jpg, depth.png and meta.json"):
        data.read_sample(tmp_path)
    folder = tmp_path / "test_0001"
    data.save_sample(make_sample(), folder)
    cv2.imwrite(str(folder / "depth.png"), np.zeros((24, 32), np.uint8))
    with pytest.raises(ValueError, match="16-bit single-channel PNG in millimetres, got uint8"):
        data.read_sample(folder)
    (folder / "rgb.jpg").unlink()
    with pytest.raises(ValueError, match="no file .*rgb.jpg"):
        data.read_sample(folder)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("{}", "KeyError.'camera'"),
        ('{"camera": null,', "as JSON"),
        ('{"camera": {"fx": 9}, "stereo": null, "meta": {}}', "missing 5 required"),
        ('{"camera": null, "stereo": {"camera": null}, "meta": {}}', "KeyError.'rgb_from_left'"),
        ('{"camera": null, "stereo": null, "meta": 3}', "TypeError"),
        ("[]", "got list"),
    ],
)
def test_a_meta_file_that_is_no_use_is_named(tmp_path, text, found):
    folder = tmp_path / "test_0001"
    data.save_sample(make_sample(), folder)
    (folder / "meta.json").write_text(text)
    with pytest.raises(ValueError, match=rf"test_0001.meta\.json.*{found}"):
        data.read_sample(folder)


def test_clean_depth_on_every_kind_of_bad_reading():
    raw = np.array([0.5, np.nan, np.inf, -np.inf, -1.0, 65.535, 0.0, 64.0])
    clean = units.clean_depth(raw)
    assert clean.dtype == np.float32
    np.testing.assert_array_equal(clean, np.array([0.5, 0, 0, 0, 0, 0, 0, 64], np.float32))
    assert np.isnan(raw[1])  # the input is left alone


@settings(max_examples=50, deadline=None)
@given(arrays(np.float32, (3, 4), elements=st.floats(width=32)))
def test_clean_depth_is_idempotent_and_bounded(raw):
    clean = units.clean_depth(raw)
    assert np.isfinite(clean).all() and (clean >= 0).all() and (clean < units.MAX_DEPTH_M).all()
    np.testing.assert_array_equal(clean, units.clean_depth(clean))
    kept = clean > 0
    np.testing.assert_array_equal(clean[kept], raw[kept])


@settings(max_examples=50, deadline=None)
@given(arrays(np.float32, (3, 4), elements=st.floats(0, 60, width=32)))
def test_millimetres_are_right_to_half_of_one(depth):
    png = units.depth_to_png(depth)
    assert png.dtype == np.uint16
    assert np.abs(png / 1000.0 - depth).max() <= 0.0005 + 4e-6  # float32 spacing at 60 m
    assert (png[depth == 0] == 0).all()


def test_a_resized_camera_sees_the_same_rays():
    camera = Camera(600.0, 610.0, 321.3, 238.9, 640, 480)
    half = camera.resized(320, 240)
    # the corner of the image, half a pixel outside the first pixel's centre, is the same ray in both
    assert np.isclose((-0.5 - camera.cx) / camera.fx, (-0.5 - half.cx) / half.fx)
    assert np.isclose((639.5 - camera.cx) / camera.fx, (319.5 - half.cx) / half.fx)
    assert np.isclose((479.5 - camera.cy) / camera.fy, (239.5 - half.cy) / half.fy)
    back = half.resized(640, 480)
    assert np.allclose([back.cx, back.cy, back.fx], [camera.cx, camera.cy, camera.fx])


def test_the_deepest_pixel_is_of_the_largest_piece_not_of_the_thickest():
    region = np.zeros((40, 60), bool)
    region[5:16, 5:16] = True  # 121 pixels, 6 deep in the middle
    region[22:29, 20:50] = True  # 210 pixels, 4 deep: larger, though thinner
    row, column = data.deepest_pixel(region)
    assert row == 25 and 23 <= column <= 46
    assert all(type(k) is int for k in (row, column))
    region[16:22, 16] = True  # a bridge that touches both at corners only makes them one piece
    region[21, 17:20] = True
    assert data.deepest_pixel(region) == (10, 10)
    with pytest.raises(ValueError, match="empty"):
        data.deepest_pixel(np.zeros((4, 4), bool))


def test_the_followed_scene_has_the_largest_region_of_the_first_twelve_test_scenes(tmp_path):
    region = np.zeros((24, 32), np.uint8)
    for k in range(14):
        material = region.copy()
        size = 20 if k == 13 else 3 + k % 8  # the last is larger still, but not among the first twelve
        material[2 : 2 + size, 4 : 4 + size] = 1
        sample = replace(make_sample(f"test_{k:05d}"), material=material, region=material > 0)
        data.save_sample(sample, tmp_path / "test" / sample.name)
    scene, at = data.followed(tmp_path)
    assert scene.name == "test_00007" and at == data.deepest_pixel(scene.region) and scene.region[at]


def test_the_shipped_followed_pixel():
    scene, at = data.followed()
    assert (scene.name, at) == ("test_00003", (147, 221)) and scene.depth[at] == 0  # a golden value beside the rule


@pytest.mark.parametrize("name", ["rgb.jpg", "depth.png", "depth_gt.png", "material.png"])
@pytest.mark.parametrize("share", [0, 0.5, 0.97])
def test_a_scene_whose_file_was_cut_short_is_refused(tmp_path, name, share):
    folder = tmp_path / "test_0001"
    data.save_sample(make_sample(), folder)
    whole = (folder / name).read_bytes()
    (folder / name).write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=f"cannot read .*{name}"):
        data.read_sample(folder)


def test_a_scene_whose_maps_are_of_different_sizes_is_refused(tmp_path):
    folder = tmp_path / "test_0001"
    data.save_sample(make_sample(), folder)
    cv2.imwrite(str(folder / "material.png"), np.zeros((5, 6), np.uint8))
    with pytest.raises(ValueError, match=r"material.png is \(5, 6\)"):
        data.read_sample(folder)


def test_a_failed_picture_is_an_error_and_something_else_is_never_replaced(tmp_path, monkeypatch):
    folder = tmp_path / "thesis"
    folder.mkdir()
    (folder / "chapter.tex").write_text("years of work")
    with pytest.raises(ValueError, match="holds something else than a sample"):
        data.save_sample(make_sample(), folder)
    assert (folder / "chapter.tex").read_text() == "years of work"
    monkeypatch.setattr(cv2, "imencode", lambda *_: (False, None))
    with pytest.raises(ValueError, match="cannot encode"):
        data.save_sample(make_sample(), tmp_path / "test_0001")
    assert [p.name for p in tmp_path.iterdir()] == ["thesis"]


def test_rooms_are_listed_and_loaded_like_table_tops(tmp_path):
    for name in ("rooms_train_0001", "rooms_0002"):
        data.save_sample(make_sample(name), tmp_path / name.rpartition("_")[0] / name)
    assert data.list_samples("rooms", tmp_path) == ["rooms_0002"]
    assert data.load_sample("rooms_train_0001", tmp_path).name == "rooms_train_0001"
