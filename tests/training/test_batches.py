from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from ditr_lite.boundary import boundary_maps, get_backend
from ditr_lite.conditioning import depth_bounds
from ditr_lite.data import SAMPLES, Sample, read_sample, save_sample
from ditr_lite.training import batches
from ditr_lite.training.batches import Batch, draw, draw_each, load_scenes

VAL = SAMPLES / "val"


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("guides") / "maps.npz"


@pytest.fixture(scope="module")
def scenes(cache):
    return load_scenes(VAL, 2, "classical", cache)


def rng(seed=0):
    return np.random.default_rng(seed)


def test_scenes_are_the_samples_in_order(scenes):
    assert len(scenes) == 2 and scenes.names == sorted(scenes.names)
    for i, name in enumerate(scenes.names):
        sample = read_sample(VAL / name)
        assert np.array_equal(scenes.rgb[i], sample.rgb) and np.array_equal(scenes.material[i], sample.material)
        for key in ("depth", "depth_gt"):
            millimetres = getattr(scenes, key)[i]
            assert millimetres.dtype == np.uint16
            assert np.abs(millimetres / 1000 - getattr(sample, key)).max() < 1e-5


def test_guides_are_the_boundary_maps_and_are_computed_once(scenes, cache, monkeypatch):
    sample = read_sample(VAL / scenes.names[1])
    m_rgb, _, m_da = boundary_maps(sample.rgb, sample.depth, get_backend("classical"))
    assert np.array_equal(scenes.guides[1], [m_rgb, m_da])
    monkeypatch.setattr(batches, "ThreadPoolExecutor", None)  # nothing may be computed
    assert np.array_equal(load_scenes(VAL, 2, "classical", cache).guides, scenes.guides)


def test_maps_of_other_weights_are_not_taken_from_the_cache(tmp_path, monkeypatch):
    class Marked:
        def __init__(self, fingerprint, answer):
            self.fingerprint, self.answer = fingerprint, answer

        def __call__(self, image):
            return np.full(image.shape[:2], self.answer)

    for fingerprint, answer in (("before", False), ("after", True), ("before", False)):
        made = Marked(fingerprint, answer)
        monkeypatch.setattr(batches, "get_backend", lambda name, made=made: made)
        guides = load_scenes(VAL, 1, "learned", tmp_path / "maps.npz").guides
        assert guides.all() == answer and guides.any() == answer


def small(folder, shape, count=2):
    """Write scenes of (H, W) pixels, cut from a shipped one."""
    full, (height, width) = read_sample(VAL / "val_00000"), shape
    for k in range(count):
        keys = ("rgb", "depth", "depth_gt", "material")
        maps = {key: getattr(full, key)[k : height + k, :width].copy() for key in keys}
        save_sample(Sample(f"s_{k}", **maps), folder / f"s_{k}")


def test_a_size_that_fills_no_whole_byte_and_scenes_rendered_again_at_another(tmp_path):
    for shape in ((95, 127), (64, 96)):
        small(tmp_path / "scenes", shape)
        scenes = load_scenes(tmp_path / "scenes", boundary="classical", cache=tmp_path / "maps.npz")
        metres = scenes.depth[1].astype(np.float32) / 1000
        m_rgb, _, m_da = boundary_maps(scenes.rgb[1], metres, get_backend("classical"))
        assert scenes.guides.shape == (2, 2, *shape) and np.array_equal(scenes.guides[1], [m_rgb, m_da])
    assert len(np.load(tmp_path / "maps.npz")["names"]) == 2  # maps of the pictures that are gone are gone


def test_a_damaged_cache_is_computed_anew(tmp_path):
    small(tmp_path / "scenes", (64, 96), 1)
    cache = tmp_path / "maps.npz"
    guides = load_scenes(tmp_path / "scenes", boundary="classical", cache=cache).guides
    whole = cache.read_bytes()
    for damaged in (b"", b"no archive", whole[: len(whole) // 2], whole[:60] + b"\0" * 60 + whole[120:]):
        cache.write_bytes(damaged)
        again = load_scenes(tmp_path / "scenes", boundary="classical", cache=cache).guides
        assert np.array_equal(again, guides) and cache.read_bytes() == whole


@pytest.mark.parametrize("key", ["depth_gt", "material"])
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


def test_a_checksum_is_of_every_map_and_name(scenes):
    plain = batches.checksum(scenes)
    assert batches.checksum(batches.first(scenes, None)) == plain
    others = [replace(scenes, guides=None), replace(scenes, names=["a", "b"]), batches.first(scenes, 1)]
    for key in batches.MAPS:
        maps = getattr(scenes, key).copy()
        maps[1, -1, -1] += 1
        others.append(replace(scenes, **{key: maps}))
    assert len({plain, *map(batches.checksum, others)}) == len(others) + 1


def test_a_folder_without_scenes_is_refused(tmp_path):
    (tmp_path / "train_00000.part").mkdir()
    (tmp_path / "train_00000.part" / "meta.json").touch()  # half written
    with pytest.raises(ValueError, match="no scenes in .*make samples"):
        load_scenes(tmp_path)


def test_plain_batch_is_the_scene_in_network_units(scenes):
    batch = draw(scenes, np.array([1]), rng(), augment=False)
    depth, gt = scenes.depth[1] / 1000, scenes.depth_gt[1] / 1000
    bounds = depth_bounds(depth.astype(np.float32))
    assert np.array_equal(batch.valid[0, 0] > 0, depth > 0) and np.array_equal(batch.gt_known[0, 0] > 0, gt > 0)
    assert (batch.depth_n[batch.valid == 0] == 0).all() and (batch.gt_n[batch.gt_known == 0] == 0).all()
    for normalised, metres in ((batch.depth_n, depth), (batch.gt_n, gt)):
        back = bounds.denormalise(normalised[0, 0].numpy())
        assert np.abs(back - metres)[metres > 0].max() < 1e-5
    assert float(batch.scale_m) == pytest.approx((bounds.high - bounds.low) / 2)
    assert batch.material.dtype == torch.int64 and np.array_equal(batch.material[0], scenes.material[1])
    assert np.array_equal(torch.cat([batch.guide_rgb, batch.guide_da], 1)[0], scenes.guides[1])
    assert batch.rgb.min() >= -1 and batch.rgb.max() <= 1 and not batch.flipped[0]


def test_a_seed_draws_the_same_batch_again(scenes):
    index = np.array([0, 1, 1])
    one, again, other = (draw(scenes, index, rng(seed)) for seed in (3, 3, 4))
    for f in fields(Batch):
        assert np.array_equal(getattr(one, f.name), getattr(again, f.name)), f.name
    assert not torch.equal(one.rgb, other.rgb) and not torch.equal(one.rgb[1], one.rgb[2])


def test_each_frame_can_have_its_own_generator(scenes):
    together = draw_each(scenes, np.array([0, 1]), [rng(7), rng(8)])
    alone = draw_each(scenes, np.array([1]), [rng(8)])
    for f in fields(Batch):
        assert np.array_equal(getattr(together, f.name)[1:], getattr(alone, f.name)), f.name


def test_augmentation_mirrors_everything_and_only_removes_readings(scenes):
    index = np.zeros(12, int)
    plain = draw(scenes, index[:1], rng(), augment=False)
    batch = draw(scenes, index, rng(1), colour=False)
    assert 0 < batch.flipped.sum() < 12
    for i, flipped in enumerate(batch.flipped):
        for key in ("rgb", "gt_n", "gt_known", "material", "guide_rgb", "guide_da"):
            value, truth = getattr(batch, key)[i], getattr(plain, key)[0]
            assert torch.equal(value, truth.flip(-1) if flipped else truth), key
        valid, depth = ((a[0].flip(-1) if flipped else a[0]) for a in (plain.valid, plain.depth_n))
        assert (batch.valid[i] <= valid).all()
        assert torch.equal(batch.depth_n[i], depth * batch.valid[i])
    assert len({float(v.sum()) for v in batch.valid}) > 3  # readings do get lost
    assert torch.equal(batch.scale_m, plain.scale_m.expand(12, -1, -1, -1))  # and the bounds stay the frame's


def test_colours_vary_only_where_asked(scenes):
    index = np.zeros(6, int)
    varied, same = draw(scenes, index, rng(2)).rgb, draw(scenes, index, rng(2), augment=False).rgb
    assert len({float(image.mean()) for image in varied}) == 6 and len({float(image.mean()) for image in same}) == 1
