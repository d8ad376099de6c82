from dataclasses import replace

import numpy as np
import pytest
import torch
from made_scenes import make_scenes

from ditr_lite.config import override, preset
from ditr_lite.data import SAMPLES, read_sample, save_sample
from ditr_lite.region import IGNORE
from ditr_lite.training import scenes as module
from ditr_lite.training.scenes import MAPS, Pool, checkpoint_key, checksum, first, load_scenes, shrink
from ditr_lite.units import depth_to_png
from ditr_lite.windows import fit_frame

VAL = SAMPLES / "val"


def test_scenes_are_the_samples_in_order():
    scenes = load_scenes(VAL, 2)
    assert len(scenes) == 2 and scenes.names == sorted(scenes.names)
    for i, name in enumerate(scenes.names):
        sample = read_sample(VAL / name)
        for key in ("rgb", "material", "instances"):
            assert np.array_equal(getattr(scenes, key)[i], getattr(sample, key)), key
        for key in ("depth", "depth_gt"):
            millimetres = getattr(scenes, key)[i]
            assert millimetres.dtype == np.uint16
            assert np.abs(millimetres / 1000 - getattr(sample, key)).max() < 1e-5


@pytest.mark.parametrize("key", ["depth_gt", "material", "instances"])
def test_a_scene_without_truth_is_named(tmp_path, key):
    full = read_sample(VAL / "val_00000")
    save_sample(replace(full, name="s_0"), tmp_path / "s_0")
    save_sample(replace(full, name="s_1", **{key: None}), tmp_path / "s_1")
    with pytest.raises(ValueError, match=f"s_1 has no {key}"):
        load_scenes(tmp_path)


@pytest.mark.parametrize("limit", [0, -3])
def test_a_limit_below_one_is_refused(limit):
    with pytest.raises(ValueError, match=r"--limit\) should be at least 1"):
        load_scenes(VAL, limit)


def test_a_folder_without_scenes_is_refused(tmp_path):
    (tmp_path / "train_00000.part").mkdir()
    (tmp_path / "train_00000.part" / "meta.json").touch()  # half written
    with pytest.raises(ValueError, match="no scenes in .*make samples"):
        load_scenes(tmp_path)


def test_a_checksum_is_of_every_map_and_name():
    scenes = make_scenes(2, (24, 32))
    plain = checksum(scenes)
    assert checksum(first(scenes, None)) == plain
    others = [replace(scenes, names=["a", "b"]), first(scenes, 1)]
    for key in MAPS:
        maps = getattr(scenes, key).copy()
        maps[1, -1, -1] += 1
        others.append(replace(scenes, **{key: maps}))
    assert len({plain, checksum(scenes, scenes), *map(checksum, others)}) == len(others) + 2


def test_a_checkpoint_is_of_its_sizes_its_scenes_and_the_networks_below():
    tiny, groups, net = preset("tiny"), [make_scenes(2, (24, 32))], torch.nn.Linear(2, 1)
    plain = checkpoint_key(tiny, groups, {"encoder": net})
    assert checkpoint_key(tiny, groups, {"encoder": net}) == plain
    others = [
        checkpoint_key(override(tiny, evidence=not tiny.evidence), groups, {"encoder": net}),
        checkpoint_key(tiny, [first(groups[0], 1)], {"encoder": net}),
        checkpoint_key(tiny, groups, {"autoencoder": net}),
        checkpoint_key(tiny, groups, {"encoder": torch.nn.Linear(2, 1)}),
    ]
    assert len({plain, *others}) == 5


def test_scenes_shrink_map_by_map():
    scenes = make_scenes(3, (48, 64))
    small = shrink(scenes, (24, 32))
    assert small.names == scenes.names
    for key in MAPS:
        assert getattr(small, key).shape[:3] == (3, 24, 32) and getattr(small, key).dtype == getattr(scenes, key).dtype
    assert set(np.unique(small.instances)) == {0, 1, 2}


def test_scenes_shrink_as_the_system_brings_a_frame_there():
    scenes = make_scenes(2, (48, 80))
    scenes.depth[np.random.default_rng(0).random(scenes.depth.shape) < 0.7] = 0
    small, frame = shrink(scenes, (24, 32)), fit_frame((48, 80), (24, 32))
    for depth, found in zip(scenes.depth, small.depth, strict=True):
        assert np.array_equal(found, depth_to_png(frame.into(depth.astype(np.float32) / 1000)))
    assert (small.depth[:, frame.picture] > 0).mean() > 0.7  # a cell holds six pixels
    assert (small.material[:, ~frame.picture] == IGNORE).all() and (small.material[:, frame.picture] < 3).all()


def test_a_pool_draws_its_groups_by_their_shares():
    groups = make_scenes(3, (24, 32)), make_scenes(1, (16, 24))
    rng = np.random.default_rng(0)
    for shares, wanted in ((None, 0.75), ((1, 3), 0.25), ((0, 1), 0.0)):
        pool = Pool(groups, shares)
        drawn = [pool.pick(rng) for _ in range(400)]
        assert np.mean([g is groups[0] for g, _ in drawn]) == pytest.approx(wanted, abs=0.08)
        assert all(0 <= i < len(g) for g, i in drawn) and len(pool) == 4
    assert {i for g, i in drawn if g is groups[0]} <= {0, 1, 2}


@pytest.mark.parametrize("shares", [(1,), (-1, 2), (0, 0)])
def test_shares_that_are_none_are_refused(shares):
    with pytest.raises(ValueError, match="a share of at least 0 for each of 2 groups"):
        Pool([make_scenes(1, (16, 24))] * 2, shares)
    with pytest.raises(ValueError, match="each of 0 groups"):
        module.Pool([])
