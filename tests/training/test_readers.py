"""Real datasets as training scenes; the files are our own scenes, exported in each dataset's layout."""

import os
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
from made_scenes import make_scenes

import ditr_lite as dl
from ditr_lite.config import preset
from ditr_lite.data import Sample
from ditr_lite.datasets import REGISTRY
from ditr_lite.datasets.export import WRITERS, export
from ditr_lite.region import IGNORE
from ditr_lite.training import readers
from ditr_lite.training.readers import RealFrames, stored_size
from ditr_lite.training.scenes import MAPS, Scenes, checksum, every, join, load_scenes

TINY = preset("tiny")
NAMES = dl.list_samples("val")[:3]


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Three scenes of the validation split in every layout."""
    root = tmp_path_factory.mktemp("exported")
    samples = [dl.load_sample(name) for name in NAMES]
    for name in WRITERS:
        export(name, root / name, samples)
    return root


@pytest.mark.parametrize("name", WRITERS)
def test_every_reader_is_training_data_for_what_it_can_teach(exported, name, tmp_path):
    frames = RealFrames(name, exported / name, cache=tmp_path)
    [group] = frames.scenes("region", TINY, None)
    assert len(group) == (6 if name == "transcg" else 3)  # two cameras saw each scene
    assert group.depth.shape[1:] == group.rgb[0].shape[:2] and group.depth[0].dtype == np.uint16
    for part in ("autoencoder", "optical", "geometric", "detail"):
        if name == "trosd" or (name, part) == ("cleargrasp_synthetic", "geometric"):  # no truth; no hole outside
            with pytest.raises(ValueError, match=f"no frame of {name} in .* teaches '{part}': it needs"):
                frames.scenes(part, TINY, None)
        else:
            assert frames.scenes(part, TINY, None)


def test_frames_through_a_reader_are_the_scenes(exported, tmp_path):
    scenes = load_scenes(dl.data.SAMPLES / "val", 3)
    [group] = RealFrames("folder", exported / "folder", cache=tmp_path).scenes("optical", preset("lite"), None)
    for name in ("depth", "depth_gt"):
        assert all(np.array_equal(getattr(group, name)[i], getattr(scenes, name)[i]) for i in range(3))
    assert all(np.array_equal(group.material[i] > 0, scenes.material[i] > 0) for i in range(3))


def test_frames_to_validate_on_may_lie_in_a_folder_of_their_own(exported, tmp_path):
    shutil.copytree(exported / "folder", tmp_path / "mine")
    plain = RealFrames("folder", exported / "folder", cache=tmp_path / "cache")
    assert plain.held_out("optical", TINY) == {}
    [(name, group)] = replace(plain, val_root=tmp_path / "mine").held_out("optical", TINY).items()
    assert name == "folder_mine" and len(group) == 3
    for again in (exported / "folder", exported / "todd" / ".." / "folder"):
        with pytest.raises(ValueError, match="are trained on and cannot judge: name another --val-root"):
            replace(plain, val_root=again).held_out("optical", TINY)
    todd = RealFrames("todd", exported / "todd", cache=tmp_path / "cache")
    for both in ({"split": None, "val_split": "val"}, {"split": "val", "val_root": exported / "todd"}):  # None: all
        with pytest.raises(ValueError, match="or --split and --val-split"):
            replace(todd, **both).held_out("region", TINY)
    assert replace(todd, split="train", val_split="val").held_out("region", TINY)


def test_the_unit_of_a_folder_of_ones_own_can_be_said(exported, tmp_path):
    plain = RealFrames("folder", exported / "folder", cache=tmp_path)
    [metric], [tenth] = (f.scenes("optical", TINY, None) for f in (plain, replace(plain, depth_scale=0.0001)))
    assert np.abs(metric.depth[0] - 10.0 * tenth.depth[0]).max() <= 5 and tenth.depth[0].any()
    with pytest.raises(ValueError, match="--depth-scale is of --dataset folder; the unit of todd is known"):
        replace(plain, name="todd", depth_scale=0.001)


def test_decoded_frames_are_kept_and_made_again_when_something_changes(exported, tmp_path, monkeypatch):
    frames, calls = RealFrames("folder", exported / "folder", cache=tmp_path), []
    real = readers._decode
    monkeypatch.setattr(readers, "_decode", lambda *a: calls.append(1) or real(*a))
    keys = []
    for part in ("optical", "geometric", "optical"):
        keys.append(checksum(*frames.scenes(part, TINY, None)))
    assert len(calls) == 1 and keys[0] == keys[2] != keys[1]
    replace(frames, zero_region=True).scenes("optical", TINY, None)
    replace(frames, limit=2).scenes("optical", TINY, None)
    assert len(calls) == 3


@pytest.mark.parametrize("name", WRITERS)
def test_the_files_of_a_frame_are_those_that_its_maps_depend_on(exported, name, tmp_path):
    root = shutil.copytree(exported / name, tmp_path / name)
    reader = REGISTRY[name](root)
    first = reader.names[0]
    [told] = reader.files([first])
    before, needed = reader[first], set()
    for path in [path for path in root.rglob("*") if path.is_file()]:
        aside = path.rename(tmp_path / "aside")
        try:
            now = reader[first]
            same = [np.array_equal(getattr(now, key), getattr(before, key)) for key in (*MAPS, "region")]
        except ValueError:  # it cannot be read without this file
            same = [False]
        aside.rename(path)
        needed |= set() if all(same) else {path}
    assert set(told) == needed and len(told) == len(needed) >= 3


@pytest.mark.parametrize("kind", ["rgb", "depth", "region", "truth"])
def test_frames_are_decoded_again_when_any_of_their_files_changes(exported, tmp_path, kind):
    root = shutil.copytree(exported / "folder", tmp_path / "folder")
    frames = RealFrames("folder", root, cache=tmp_path / "cache")
    kept = [frames.scenes("region", TINY, None)[0].key]
    one, other = sorted((root / kind).iterdir())[:2]
    shutil.copy(other, one)
    kept.append(frames.scenes("region", TINY, None)[0].key)
    if kind in ("region", "truth"):  # which a frame may lack
        one.unlink()
        kept.append(frames.scenes("region", TINY, None)[0].key)
    assert len(set(kept)) == len(kept)


def test_an_edit_that_keeps_the_size_of_a_file_is_noticed(exported, tmp_path):
    root = shutil.copytree(exported / "folder", tmp_path / "folder")
    frames, path = RealFrames("folder", root, cache=tmp_path / "cache", limit=1), min((root / "depth").iterdir())
    [before] = frames.scenes("region", TINY, None)
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 1_000_000))
    [after] = frames.scenes("region", TINY, None)
    assert before.key != after.key


def in_memory(scenes):
    return Scenes(names=scenes.names, **{name: np.stack([*getattr(scenes, name)]) for name in MAPS})


def test_frames_that_are_chosen_stay_on_disk(exported, tmp_path):
    [group] = RealFrames("folder", exported / "folder", cache=tmp_path).scenes("optical", TINY, None)
    some = every(group, [0, 2])
    assert all(isinstance(getattr(some, name), readers.Rows) for name in MAPS)
    assert some.names == [group.names[0], group.names[2]] and np.array_equal(some.depth[1], group.depth[2])
    assert len({checksum(some), checksum(every(group, [0, 1])), checksum(group)}) == 3
    assert join([some], TINY.size) is some


def test_rows_are_sent_to_another_process_by_their_place(exported, tmp_path):
    [group] = RealFrames("folder", exported / "folder", cache=tmp_path).scenes("optical", TINY, None)
    sent = pickle.dumps(group)
    assert len(sent) < 10_000 < group.depth.array.nbytes
    again = pickle.loads(sent)
    assert checksum(in_memory(again)) == checksum(in_memory(group)) and not again.depth.array.flags.writeable
    assert np.array_equal(pickle.loads(pickle.dumps(group.rgb[1:]))[0], group.rgb[1])
    [folder] = tmp_path.iterdir()
    depth = folder / "0_depth.bin"
    depth.write_bytes(bytes(depth.stat().st_size))
    with pytest.raises(ValueError, match=f"a decoded frame in {folder} is damaged"):
        pickle.loads(sent).depth[0]


def test_damaged_frames_are_noticed_and_a_spoilt_folder_is_made_again(exported, tmp_path):
    frames = RealFrames("folder", exported / "folder", cache=tmp_path)
    [whole] = frames.scenes("optical", TINY, None)
    wanted = in_memory(whole)
    [folder] = tmp_path.iterdir()
    depth, description = folder / "0_depth.bin", folder / "frames.json"
    data = bytearray(depth.read_bytes())
    data[len(data) // 2] ^= 16  # in the second of three frames
    depth.write_bytes(data)
    [spoilt] = frames.scenes("optical", TINY, None)
    assert np.array_equal(spoilt.depth[0], wanted.depth[0]) and np.array_equal(spoilt.rgb[1], wanted.rgb[1])
    with pytest.raises(ValueError, match=f"a decoded frame in {folder} is damaged: delete that folder"):
        spoilt.depth[1]
    text = description.read_text()
    for file, damage in (
        (depth, b"cut"),
        (description, text.replace("true", "fals", 1).encode()),
        (description, text.replace("val_00001", "val_00007").encode()),
        (description, b"\xff"),
    ):
        file.write_bytes(damage)
        [again] = frames.scenes("optical", TINY, None)
        assert checksum(in_memory(again)) == checksum(wanted)


def test_zeroed_regions_have_no_reading_and_all_else_stays(exported, tmp_path):
    plain = RealFrames("todd", exported / "todd", cache=tmp_path)
    [kept] = plain.scenes("optical", TINY, None)
    [zeroed] = replace(plain, zero_region=True).scenes("optical", TINY, None)
    region = kept.material[0] > 0
    assert kept.depth[0][region].any() and not zeroed.depth[0][region].any()
    assert np.array_equal(kept.depth[0][~region], zeroed.depth[0][~region])


def test_the_share_of_rendered_scenes_is_that_of_the_draws(exported, tmp_path):
    frames = RealFrames("folder", exported / "folder", scene_share=0.75, cache=tmp_path)
    rendered = [make_scenes(4, (48, 64)), make_scenes(12, (48, 64), 1)]
    pool = frames.pool("optical", TINY, rendered)
    assert pool.shares == pytest.approx([0.25, 0.1875, 0.5625])
    assert replace(frames, scene_share=0.0).pool("optical", TINY, rendered).shares == pytest.approx([1.0])
    with pytest.raises(ValueError, match="needs some: give --data"):
        frames.pool("optical", TINY, [])
    for wrong in ({"scene_share": 1.5}, {"name": "nyu"}):
        with pytest.raises(ValueError, match="from 0 to 1|unknown dataset 'nyu'; choose one of cleargrasp"):
            replace(frames, **wrong)


def test_large_frames_are_kept_at_twice_the_working_size_and_far_readings_are_missing():
    assert stored_size((720, 1280), (192, 256)) == (384, 683) and stored_size((240, 320), (192, 256)) == (240, 320)
    depth = np.full((400, 600), 0.5, np.float32)
    depth[:4, :4], depth[:2, 100:] = 70.0, 0
    sample = Sample("a", np.zeros((400, 600, 3), np.uint8), depth, depth_gt=depth)
    maps, can = readers._maps(sample, (200, 300), False)
    assert maps["rgb"].shape == (200, 300, 3) and (maps["material"] == IGNORE).all()
    for name in ("depth", "depth_gt"):
        assert not maps[name][:2, :2].any() and set(np.unique(maps[name])) == {0, 500}
    assert can == [False, False, False, False]  # nobody said where the glass is


def test_kept_frames_cover_what_scenes_have():
    assert set(MAPS) == {"rgb", "depth", "depth_gt", "material", "instances"}
