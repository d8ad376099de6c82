from dataclasses import replace

import numpy as np
import pytest
from made_scenes import make_scenes

from ditr_lite.region import IGNORE
from ditr_lite.training import views
from ditr_lite.training.views import (
    blunder,
    disturb,
    false_claim,
    frame_view,
    grow,
    look,
    lose,
    mix_views,
    placement,
    read_truly,
    spoil,
    thin_out,
    window_view,
)
from ditr_lite.windows import fit_frame


@pytest.fixture(scope="module")
def scenes():
    return make_scenes(2, (48, 64))


def rng(seed=0):
    return np.random.default_rng(seed)


def box(shape=(40, 60)):
    out = np.zeros(shape, bool)
    out[10:30, 20:40] = True
    return out


# --- placing ----------------------------------------------------------------------------------------------------------


def test_a_plain_frame_is_the_scene_itself(scenes):
    view = frame_view(scenes, 1, (48, 64), None)
    assert np.array_equal(view.rgb, scenes.rgb[1]) and np.array_equal(view.material, scenes.material[1])
    assert np.allclose(view.depth, scenes.depth[1] / 1000) and np.allclose(view.depth_gt, scenes.depth_gt[1] / 1000)
    assert np.array_equal(view.region, scenes.material[1] > 0) and view.depth.dtype == np.float32


def test_a_frame_of_another_aspect_has_borders_that_are_not_scored(scenes):
    view = frame_view(scenes, 0, (64, 64), None)
    above = np.s_[:6]
    assert (view.material[above] == IGNORE).all() and not view.depth[above].any() and not view.depth_gt[above].any()
    assert not view.region[above].any() and (view.material[10:54] != IGNORE).all()


def test_a_placement_shows_its_centre_in_the_middle_and_scales_turns_and_mirrors():
    for angle, mirror in ((0.0, False), (0.7, False), (np.pi / 2, True)):
        matrix = placement((11, 21), (30.0, 50.0), 2.0, angle, mirror)
        assert np.allclose(matrix @ [10, 5, 1], [50, 30], atol=1e-4)  # (x, y) of the view's middle
        assert np.linalg.det(matrix[:, :2]) == pytest.approx(-4 if mirror else 4, rel=1e-5)
    right = placement((11, 21), (30.0, 50.0), 2.0, np.pi / 2, False) @ [11, 5, 1]
    assert np.allclose(right, [50, 32], atol=1e-4)  # a quarter turn: right becomes down


def test_all_maps_of_a_view_move_together(scenes):
    ramp = np.tile(np.arange(500, 564, dtype=np.uint16), (2, 48, 1))
    grey = np.repeat((2 * (ramp - 500)).astype(np.uint8)[..., None], 3, axis=3)
    marked = replace(scenes, depth=ramp, depth_gt=ramp, rgb=grey, material=(ramp % 3).astype(np.uint8))
    for seed in range(6):
        view = frame_view(marked, 0, (48, 64), rng(seed))
        seen = view.depth > 0
        assert np.array_equal(view.depth, view.depth_gt) and seen.mean() > 0.3
        millimetres = np.rint(view.depth[seen] * 1000)
        assert np.array_equal(view.material[seen], millimetres % 3)
        assert np.abs(view.rgb[seen][:, 0] / 2 + 500 - millimetres).max() <= 1.5
        assert (view.material[~seen] == IGNORE).all()


def test_a_shrunken_view_keeps_sparse_readings_as_the_system_does(scenes):
    depth = np.zeros_like(scenes.depth)
    depth[:, 1::4, 2::4] = 500 + np.arange(192).reshape(12, 16)  # in every other cell of 2 x 2, beside its centre
    sparse = replace(scenes, depth=depth)
    view = frame_view(sparse, 0, (24, 32), None)
    system = fit_frame((48, 64), (24, 32)).into(depth[0].astype(np.float32) / 1000)
    assert (system > 0).sum() == 12 * 16 and np.array_equal(view.depth, system)
    assert np.array_equal(view.rgb, fit_frame((48, 64), (24, 32)).into(scenes.rgb[0]))  # colour by area
    for seed in range(4):  # moved, turned, mirrored: every reading shown survives where it lies
        angle, mirror = 0.5 * seed, bool(seed % 2)
        matrix = placement((24, 32), (23.5, 31.5), 2.2, angle, mirror)
        seen = look(sparse, 0, matrix, (24, 32)).depth
        rows, columns = np.nonzero(depth[0])
        x, y = np.linalg.solve(matrix[:, :2], np.stack([columns, rows]) - matrix[:, 2:])
        u, v = np.rint(x).astype(int), np.rint(y).astype(int)
        middle = matrix[:, :2] @ np.stack([u, v]) + matrix[:, 2:]  # of the pixel it falls on, which may lie outside
        shown = (u >= 0) & (u < 32) & (v >= 0) & (v < 24) & ((middle > 0) & (middle < [[63], [47]])).all(axis=0)
        assert shown.sum() > 60
        assert (seen[v[shown], u[shown]] > 0).all()
        assert set(np.rint(1000 * seen[seen > 0]).astype(int)) <= set(depth[0][depth[0] > 0].tolist())


def test_where_a_centre_lies_between_two_pixels_a_view_takes_the_one_that_the_system_takes(scenes):
    numbered = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64) + 500
    kinds = (numbered % 3).astype(np.uint8)
    marked = replace(scenes, depth=np.stack([numbered] * 2), material=np.stack([kinds] * 2))
    view, frame = frame_view(marked, 0, (24, 32), None), fit_frame((48, 64), (24, 32))
    assert np.array_equal(np.rint(1000 * view.depth), frame.into(numbered.astype(np.float32)))
    assert np.array_equal(view.material, frame.into(kinds))


def test_views_differ_and_repeat(scenes):
    one, again, other = (frame_view(scenes, 0, (48, 64), rng(s)) for s in (3, 3, 4))
    assert np.array_equal(one.rgb, again.rgb) and not np.array_equal(one.rgb, other.rgb)


def test_a_window_holds_the_glass_at_its_middle(scenes):
    for seed in range(20):
        view = window_view(scenes, 0, (32, 32), rng(seed), mistaken=0.0)
        assert view.rgb.shape == (32, 32, 3) and view.region.any()
        rows, columns = np.nonzero(view.region)
        assert abs(rows.mean() - 15.5) < 9 and abs(columns.mean() - 15.5) < 9
        glass = (view.material == 1) | (view.material == 2)
        assert (view.region | ~glass).mean() > 0.9  # shrunk by at most a pixel


def test_a_mistaken_window_claims_what_is_opaque(scenes):
    nothing = replace(scenes, material=np.zeros_like(scenes.material))
    shares = []
    for seed in range(20):
        view = window_view(nothing, 0, (32, 32), rng(seed))
        assert not ((view.material == 1) | (view.material == 2)).any()
        shares.append(view.region.mean())
    assert np.mean(np.array(shares) > 0) > 0.7 and np.mean(shares) < 0.8


def test_a_false_claim_is_a_thing_or_a_patch(scenes):
    drawn = [false_claim(scenes, 0, rng(k)) for k in range(40)]
    cup = scenes.instances[0] == 2
    things = np.mean([np.array_equal(d, cup) for d in drawn])
    assert 0.5 < things < 0.9 and all(d.dtype == bool and d.shape == (48, 64) for d in drawn)
    assert all(d.any() for d in drawn)


# --- the mistakes of stage one ----------------------------------------------------------------------------------------


def test_growing_adds_at_most_four_pixels_and_takes_at_most_one():
    areas = set()
    for seed in range(40):
        out = grow(box(), rng(seed))
        areas.add(int(out.sum()))
    assert areas == {18 * 18, *((20 + 2 * k) ** 2 for k in range(5))}


def test_blunders_miss_a_part_and_claim_too_much_but_stay_near():
    true, far = box((80, 120)), np.zeros((80, 120), bool)
    far[:] = True
    far[10 - 14 : 30 + 14, 20 - 14 : 40 + 14] = False
    far[:44, 6:54] = False
    drawn = [blunder(true, rng(k)) for k in range(60)]
    assert np.mean([(true & ~d).any() for d in drawn]) > 0.3
    assert np.mean([(d & ~true).any() for d in drawn]) > 0.3
    assert not any((d & far).any() for d in drawn) and not any(d.all() for d in drawn)


# --- what cameras do to depth -----------------------------------------------------------------------------------------


def plane(shape=(48, 64)):
    return np.full(shape, 0.7, np.float32)


def test_losing_takes_patches_up_to_half():
    drawn = [lose(plane(), rng(k)) for k in range(60)]
    shares = np.array([(d == 0).mean() for d in drawn])
    assert 0.3 < (shares == 0).mean() < 0.75 and 0.2 < shares.max() <= 0.51
    assert all(set(np.unique(d)) <= {np.float32(0), np.float32(0.7)} for d in drawn)
    holes = drawn[int(shares.argmax())] == 0
    assert (holes[:, 1:] != holes[:, :-1]).mean() < 0.15  # patches, not single pixels


def test_spoiling_adds_few_readings_far_off():
    before = plane()
    for seed in range(20):
        out = spoil(before, rng(seed))
        changed = out != before
        ratio = out[changed] / 0.7
        assert 0 < changed.mean() < 0.02 and ((ratio >= 1.49) | (ratio <= 0.51)).all()
    assert (before == plane()).all()
    assert not spoil(np.zeros((8, 8), np.float32), rng()).any()


def test_thinning_keeps_a_few_or_every_so_many_rows():
    rows, shares = 0, []
    for seed in range(40):
        out = thin_out(plane((96, 128)), rng(seed))
        filled = (out > 0).mean(axis=1)
        rows += set(np.unique(filled)) == {0.0, 1.0}
        shares.append((out > 0).mean())
    assert 8 < rows < 32 and max(shares) <= 0.26 and min(shares) > 0


def test_glass_is_read_as_it_is_in_parts_and_nothing_else_changes(scenes):
    view = frame_view(scenes, 0, (48, 64), None)
    view = replace(view, depth=np.where(view.region, 0, view.depth))  # all of it is a hole
    true = view.region & (view.depth_gt > 0)
    shares = []
    for seed in range(40):
        out = read_truly(view, rng(seed))
        assert np.array_equal(out.depth[~true], view.depth[~true]) and out.depth.dtype == np.float32
        read = true & (out.depth > 0)
        shares.append(read.sum() / true.sum())
        if read.any():
            assert np.abs(np.log(out.depth[read] / view.depth_gt[read])).max() < 0.1
            assert np.median(out.depth[read] / view.depth_gt[read]) > 0.98  # a bias is away from the camera
    shares = np.array(shares)
    assert 0.3 < np.mean(shares == 0) < 0.7  # half of the time holes stay holes
    assert shares[shares > 0].min() < 0.5 and shares.max() > 0.6  # parts of the glass, small and large
    nothing = replace(view, material=np.zeros_like(view.material))
    assert read_truly(nothing, rng()) is nothing


def test_disturbing_leaves_the_truth_and_some_readings_alone(scenes):
    view = frame_view(scenes, 0, (48, 64), None)
    for seed in range(30):
        out = disturb(view, rng(seed))
        assert (out.depth > 0).sum() > 20
        assert out.depth_gt is view.depth_gt and out.material is view.material and out.region is view.region
    one, again = (disturb(view, rng(5)) for _ in range(2))
    assert np.array_equal(one.rgb, again.rgb) and np.array_equal(one.depth, again.depth)


def test_glare_blinds_the_sensor_where_it_says(scenes, monkeypatch):
    view, blinded, seen = frame_view(scenes, 0, (48, 64), None), np.zeros((48, 64), bool), []
    blinded[:, :20] = True
    monkeypatch.setattr(views, "glare", lambda rgb, rng: seen.append(1) or (rgb, blinded))
    monkeypatch.setattr(views, "spoil", lambda depth, rng: depth)
    for seed in range(40):
        before = len(seen)
        depth = disturb(view, rng(seed)).depth
        assert len(seen) == before or not depth[blinded].any()
    assert seen and view.depth[blinded].any()


def test_a_view_with_hardly_a_reading_is_not_thinned_out_of_all_of_them(scenes, monkeypatch):
    view = frame_view(scenes, 0, (48, 64), None)
    monkeypatch.setattr(views, "lose", lambda depth, rng: np.zeros_like(depth))
    assert np.array_equal(disturb(view, rng()).depth, view.depth)


def test_a_claim_is_cut_with_the_view(scenes):
    claimed = np.zeros((48, 64), bool)
    claimed[4:8, 50:60] = True
    view = look(scenes, 0, placement((48, 64), (23.5, 31.5), 1.0, 0.0, True), (48, 64), claimed)
    assert np.array_equal(view.region, ((scenes.material[0] > 0) | claimed)[:, ::-1])


def test_a_mixed_view_is_one_view_with_a_rectangle_of_the_other_at_a_like_distance(scenes):
    one, other = frame_view(scenes, 0, (48, 64), None), frame_view(scenes, 1, (48, 64), None)
    other = replace(other, depth=1.5 * other.depth, depth_gt=1.5 * other.depth_gt)  # of a larger room
    ratio = np.median(one.depth[one.depth > 0]) / np.median(other.depth[other.depth > 0])
    for seed in range(5):
        out = mix_views(one, other, rng(seed))
        taken = (out.rgb != one.rgb).any(axis=2)
        rows, columns = np.nonzero(taken.any(axis=1))[0], np.nonzero(taken.any(axis=0))[0]
        box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        assert np.array_equal(out.rgb[box], other.rgb[box]) and np.array_equal(out.material[box], other.material[box])
        for name in ("depth", "depth_gt"):
            assert np.allclose(getattr(out, name)[box], ratio * getattr(other, name)[box], rtol=1e-5)
        rest = np.ones(taken.shape, bool)
        rest[max(0, rows[0] - 2) : rows[-1] + 3, max(0, columns[0] - 2) : columns[-1] + 3] = False  # alike by chance
        assert np.array_equal(out.depth_gt[rest], one.depth_gt[rest]) and out.depth.dtype == np.float32
        assert np.array_equal(out.region[rest], one.region[rest]) and rest.any()
