import cv2
import numpy as np
import pytest
import torch
from made_scenes import make_scenes

from ditr_lite.boundary import boundary_maps, get_backend
from ditr_lite.conditioning import depth_bounds
from ditr_lite.data import lossy
from ditr_lite.training import batches
from ditr_lite.training.batches import (
    batch_of,
    draw_frames,
    draw_windows,
    epoch_frames,
    frames_in_order,
    windows_in_order,
)
from ditr_lite.training.loop import Share
from ditr_lite.training.scenes import Pool
from ditr_lite.training.views import View, frame_view

SIZE = (48, 64)


@pytest.fixture(scope="module")
def scenes():
    return make_scenes(3, SIZE)


def rng(seed=0):
    return np.random.default_rng(seed)


def same(one, two):
    maps = [k for k, v in vars(one).items() if isinstance(v, torch.Tensor)]
    return all(torch.equal(getattr(one, k), getattr(two, k)) for k in maps)


def test_a_plain_batch_is_the_scene_in_network_units(scenes):
    batch = next(frames_in_order(scenes, SIZE, backend=get_backend("classical")))
    for i in range(3):
        depth = (scenes.depth[i] / 1000).astype(np.float32)
        gt = scenes.depth_gt[i] / 1000
        bounds = depth_bounds(depth)
        assert float(batch.bounds.low[i]) == pytest.approx(bounds.low) and batch.bounds.high.shape == (3, 1, 1, 1)
        assert np.array_equal(batch.valid[i, 0] > 0, depth > 0) and np.array_equal(batch.gt_known[i, 0] > 0, gt > 0)
        assert np.allclose(batch.depth_n[i, 0], bounds.normalise(depth), atol=1e-5)
        assert np.allclose(batch.truth_m[i, 0], gt, atol=1e-5)  # 0 where unknown
        m_rgb, _, m_da = boundary_maps(scenes.rgb[i], depth, get_backend("classical"))
        assert np.array_equal(batch.guide_rgb[i, 0] > 0, m_rgb) and np.array_equal(batch.guide_da[i, 0] > 0, m_da)
        assert np.array_equal(batch.region[i, 0] > 0, scenes.material[i] > 0)
    assert batch.material.dtype == torch.int64 and np.array_equal(batch.material, scenes.material)
    assert batch.rgb.min() >= -1 and batch.rgb.max() <= 1
    assert next(frames_in_order(scenes, SIZE)).guide_rgb is None


def test_strays_are_hidden_from_networks(scenes):
    view = frame_view(scenes, 0, SIZE, None)
    depth = view.depth.copy()
    depth[40, 10] = 9.0
    batch = batch_of([View(view.rgb, depth, view.depth_gt, view.material, view.region)])
    assert batch.valid[0, 0, 40, 10] == 0 and batch.depth_n[0, 0, 40, 10] == 0
    assert batch.valid[0, 0, 40, 11] == 1


def test_windows_take_their_bounds_from_around_the_region(scenes):
    view = frame_view(scenes, 0, SIZE, None)
    depth = np.where(view.region, np.float32(5), view.depth)  # a room behind the glass
    mirror = View(view.rgb, depth, view.depth_gt, view.material, view.region)
    around, without = (batch_of([v], around=True).bounds for v in (mirror, view))
    assert torch.equal(around.low, without.low) and torch.equal(around.high, without.high)
    everything = batch_of([mirror]).bounds
    assert not torch.equal(everything.high, around.high)


def test_a_view_without_a_reading_still_has_bounds(scenes):
    view = frame_view(scenes, 0, SIZE, None)
    blind = View(view.rgb, 0 * view.depth, view.depth_gt, view.material, view.region)
    batch = batch_of([blind], around=True)
    assert batch.depth_n.isfinite().all() and batch.gt_n.isfinite().all()
    assert not batch.valid.any() and not batch.depth_n.any()  # nothing was read, and no reading is shown


def test_errors_are_shares_of_the_depth(scenes):
    batch = next(frames_in_order(scenes, SIZE))
    known = batch.gt_known > 0
    off = batch.bounds.normalise(batch.truth_m.clamp(min=0.1) * 1.1)
    error = batch.relative_error(off)
    assert torch.allclose(error[known], torch.tensor(1.1).log(), atol=1e-4) and (error[~known] == 0).all()
    half = batch.relative_error_m(0.5 * batch.truth_m.clamp(min=0.1))
    assert torch.allclose(half[known], torch.tensor(0.5).log(), atol=1e-4)


def test_a_seed_draws_the_same_batch_again(scenes):
    pool = Pool([scenes])
    for draw, size in ((draw_frames, SIZE), (draw_windows, 32)):
        one, again, other = (draw(pool, 3, size, rng(seed), get_backend("classical")) for seed in (3, 3, 4))
        assert same(one, again) and not torch.equal(one.rgb, other.rgb)
        assert not torch.equal(one.rgb[1], one.rgb[2])


def test_some_windows_show_glass_that_is_read_as_it_is_and_no_frame_does(scenes, monkeypatch):
    seen = []
    monkeypatch.setattr(batches, "read_truly", lambda view, rng: seen.append(view) or view)
    pool = Pool([scenes])
    draw_frames(pool, 40, SIZE, rng())
    assert not seen
    draw_windows(pool, 400, 32, rng(1))
    assert 0.3 < len(seen) / 400 < 0.5


def test_a_pool_of_sizes_gives_batches_of_one(scenes):
    pool = Pool([scenes, make_scenes(2, (30, 30))])
    assert draw_frames(pool, 5, SIZE, rng()).rgb.shape == (5, 3, *SIZE)
    assert draw_windows(pool, 5, 32, rng()).rgb.shape == (5, 3, 32, 32)


def test_in_order_means_once_and_as_they_are(scenes):
    frames = list(frames_in_order(scenes, SIZE, count=2))
    assert [len(b.rgb) for b in frames] == [2, 1]
    assert np.array_equal(torch.cat([b.material for b in frames]), scenes.material)


def test_shuffled_means_once_in_an_order_of_its_own(scenes):
    def order(seed):
        drawn = [epoch_frames(Pool([many]), SIZE, 3, seed, None, step) for step in (0, 1)]
        middles = torch.cat([batch.bounds.low.flatten() for batch in drawn])
        return [int(m * 10 + 0.5) for m in middles]

    depth = np.stack([np.full(SIZE, 1000 * 2**k, np.uint16) for k in range(5)])  # told apart by their distance
    many = make_scenes(5, SIZE)
    many = type(many)(many.names, many.rgb, depth, depth, many.material, many.instances)
    assert sorted(order(0)) == sorted(order(1)) and len(set(order(0))) == 5
    assert order(0) == order(0) and any(order(s) != order(0) for s in range(1, 5))
    assert [len(epoch_frames(Pool([many]), SIZE, 3, 0, None, step).rgb) for step in range(4)] == [3, 2, 3, 2]
    shares = [epoch_frames(Pool([many]), SIZE, 4, 0, None, 1, Share(k, 2)) for k in (0, 1)]  # filled up to be divided
    assert [len(b.rgb) for b in shares] == [2, 2]


def test_every_epoch_has_an_order_and_disturbances_of_its_own(monkeypatch):
    many, seen = make_scenes(5, SIZE), []
    view = frame_view(many, 0, SIZE, None)
    monkeypatch.setattr(batches, "frame_view", lambda scenes, i, size, rng: seen.append((i, rng.random())) or view)
    monkeypatch.setattr(batches, "disturb", lambda view, rng: view)
    for step in range(8):  # two to an epoch
        epoch_frames(Pool([many]), SIZE, 3, 0, None, step)
    orders = [tuple(i for i, _ in seen[start : start + 5]) for start in range(0, 20, 5)]
    assert len(set(orders)) > 1 and all(sorted(order) == [0, 1, 2, 3, 4] for order in orders)
    assert len({drawn for _, drawn in seen}) == 20


def test_shares_of_a_batch_are_the_batch(scenes):
    pool = Pool([scenes])
    for draw in (draw_frames, draw_windows):
        size = SIZE if draw is draw_frames else 32
        whole = draw(pool, 4, size, rng())
        halves = [draw(pool, 4, size, rng(), share=Share(k, 2)) for k in (0, 1)]
        assert torch.equal(torch.cat([h.rgb for h in halves]), whole.rgb)
        assert torch.equal(torch.cat([h.depth_n for h in halves]), whole.depth_n)


def test_windows_in_order_are_of_scenes_with_glass_and_always_the_same(scenes):
    material = scenes.material.copy()
    material[1] = 0
    some = type(scenes)(scenes.names, scenes.rgb, scenes.depth, scenes.depth_gt, material, scenes.instances)
    one, again = ([*windows_in_order(some, 32, count=8)] for _ in range(2))
    assert len(one) == 1 and len(one[0].rgb) == 2 and same(one[0], again[0])
    assert (one[0].region.sum(dim=(1, 2, 3)) > 0).all()


def test_windows_in_order_show_the_true_region_grown_or_shrunk_a_little():
    [batch] = windows_in_order(make_scenes(12, SIZE), 48, count=12)
    glass = lossy(batch.material.numpy())
    for shown, true in zip(batch.region[:, 0].numpy() > 0, glass.astype(np.uint8), strict=True):
        assert not shown[cv2.dilate(true, np.ones((9, 9), np.uint8)) == 0].any()
        assert shown[cv2.erode(true, np.ones((3, 3), np.uint8)) > 0].all()
