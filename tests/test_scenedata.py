from dataclasses import fields

import numpy as np
import pytest
import torch

from ditr_lite import scenedata
from ditr_lite.boundary import boundary_maps, get_backend
from ditr_lite.conditioning import depth_bounds
from ditr_lite.data import SAMPLES, read_sample
from ditr_lite.scenedata import Batch, draw, draw_each, load_scenes

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
    monkeypatch.setattr(scenedata, "ThreadPoolExecutor", None)  # nothing may be computed
    assert np.array_equal(load_scenes(VAL, 2, "classical", cache).guides, scenes.guides)


def test_maps_of_other_weights_are_not_taken_from_the_cache(tmp_path, monkeypatch):
    class Marked:
        def __init__(self, fingerprint, answer):
            self.fingerprint, self.answer = fingerprint, answer

        def __call__(self, image):
            return np.full(image.shape[:2], self.answer)

    for fingerprint, answer in (("before", False), ("after", True), ("before", False)):
        made = Marked(fingerprint, answer)
        monkeypatch.setattr(scenedata, "get_backend", lambda name, made=made: made)
        guides = load_scenes(VAL, 1, "learned", tmp_path / "maps.npz").guides
        assert guides.all() == answer and guides.any() == answer


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
