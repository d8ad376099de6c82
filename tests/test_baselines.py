"""Baselines: a plane with a hole, what is kept bit for bit, who may look inside the region, and bad input."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ditr_lite import baselines
from ditr_lite.baselines import REGISTRY, measure_bias
from ditr_lite.data import Sample

NAMES = list(REGISTRY)
OUTSIDE_ONLY = ["nearest", "navier_stokes", "harmonic", "joint_bilateral"]
KEEPING = ["raw", "keep_and_fill"]
H, W = 48, 64
V, U = np.mgrid[:H, :W]
PLANE = (0.5 + 0.002 * U + 0.001 * V).astype(np.float32)  # 2 mm per pixel across, 1 mm down
GREY = np.full((H, W, 3), 128, np.uint8)
REGION = (np.abs(U - 30) < 8) & (np.abs(V - 24) < 6)
MAPS = arrays(np.float32, (7, 9), elements=st.just(0.0) | st.floats(0.25, 4, width=32))


def test_registry_has_the_agreed_names():
    assert set(NAMES) == {*OUTSIDE_ONLY, *KEEPING, "keep_and_fill_debiased"}


# a plane with a hole


@pytest.mark.parametrize(
    "name, worst_m",
    [
        ("harmonic", 1e-6),  # a linear ramp is harmonic: exact
        ("keep_and_fill", 1e-6),
        ("nearest", 0.012),  # at most 6 rows of 1 mm from the next reading, and up to 3 columns of 2 mm
        ("raw", 0.012),
        ("navier_stokes", 0.010),
        ("joint_bilateral", 0.012),
    ],
)
def test_hole_in_a_plane(name, worst_m):
    depth = np.where(REGION, 0, PLANE)
    error = np.abs(REGISTRY[name](GREY, depth, REGION) - PLANE)
    assert error.max() <= worst_m


def test_harmonic_is_exact_on_a_ramp_with_many_holes():
    depth = np.where(REGION | (np.random.default_rng(0).random((H, W)) < 0.5), 0, PLANE)
    depth[[0, -1]], depth[:, [0, -1]] = PLANE[[0, -1]], PLANE[:, [0, -1]]  # at the border a ramp does not continue
    np.testing.assert_allclose(REGISTRY["harmonic"](GREY, depth, None), PLANE, atol=1e-6)


def test_harmonic_lets_nothing_flow_through_the_border():
    depth = np.zeros((5, 6), np.float32)
    depth[:, 2] = 0.7
    np.testing.assert_allclose(REGISTRY["harmonic"](np.zeros((5, 6, 3), np.uint8), depth), 0.7, rtol=1e-6)
    depth[:, 4] = 0.9
    np.testing.assert_allclose(REGISTRY["harmonic"](np.zeros((5, 6, 3), np.uint8), depth)[:, 3], 0.8, rtol=1e-6)


@settings(max_examples=25, deadline=None)
@given(MAPS.filter(lambda d: d.any()))
def test_harmonic_is_the_mean_of_its_neighbours(depth):
    filled = REGISTRY["harmonic"](np.zeros((7, 9, 3), np.uint8), depth).astype(np.float64)
    total, count = np.zeros((7, 9)), np.zeros((7, 9))
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        inside = np.roll(np.pad(np.ones((7, 9)), 1), step, axis)[1:-1, 1:-1]
        total += np.roll(np.pad(filled, 1), step, axis)[1:-1, 1:-1]
        count += inside
    np.testing.assert_allclose(filled[depth == 0], (total / count)[depth == 0], rtol=1e-5)


def test_joint_bilateral_follows_colour():
    depth = np.where(U < 32, 0.5, 1.0).astype(np.float32)
    rgb = np.where(U < 32, 40, 200).astype(np.uint8)[..., None].repeat(3, axis=-1)
    hole = (np.abs(U - 38) < 8) & (np.abs(V - 24) < 6)  # reaches over the edge, its middle does not lie on it
    filled = REGISTRY["joint_bilateral"](rgb, np.where(hole, 0, depth), None)
    np.testing.assert_allclose(filled, depth, atol=1e-3)
    blind = REGISTRY["joint_bilateral"](GREY, np.where(hole, 0, depth), None)
    assert np.abs(blind - depth).max() > 0.1


def test_joint_bilateral_weighs_readings_by_their_distance():
    depth = np.select([U < 31, U > 33], [0.5, 1.0], 0).astype(np.float32)  # three columns are missing
    near, middle, far = np.exp(-(np.arange(1, 4) ** 2) / (2 * 1.5**2))
    share = far / (near + middle + 2 * far)  # of the only column at 1 m that column 31 can see
    filled = REGISTRY["joint_bilateral"](GREY, depth)
    np.testing.assert_allclose(filled[4:-4, 31], 0.5 + 0.5 * share, rtol=1e-5)
    np.testing.assert_allclose(filled[4:-4, 32], 0.75, rtol=1e-5)


def test_joint_bilateral_waits_for_readings_of_its_own_colour():
    depth = np.select([U < 24, U > 31], [0.5, 1.0], 0).astype(np.float32)
    rgb = np.where(U < 32, 40, 65).astype(np.uint8)[..., None].repeat(3, axis=-1)  # the hole looks like what is at 0.5
    filled = REGISTRY["joint_bilateral"](rgb, depth)
    assert filled[:, 24:32].max() < 0.6


# contracts common to all


@settings(max_examples=25, deadline=None)
@given(MAPS, arrays(bool, (7, 9)), st.sampled_from(NAMES))
def test_dense_and_readings_outside_bit_for_bit(depth, region, name):
    outside = ~region & (depth > 0)
    if not outside.any():
        return
    rgb = np.random.default_rng(0).integers(0, 256, (7, 9, 3), dtype=np.uint8)
    before = depth.copy(), region.copy(), rgb.copy()
    filled = REGISTRY[name](rgb, depth, region)
    assert filled.dtype == np.float32 and filled.shape == depth.shape
    assert np.isfinite(filled).all() and (filled > 0).all()
    np.testing.assert_array_equal(filled[outside], depth[outside])
    for given_array, copy in zip((depth, region, rgb), before, strict=True):
        np.testing.assert_array_equal(given_array, copy)
    if name in OUTSIDE_ONLY:
        assert depth[outside].min() * 0.9999 <= filled.min() and filled.max() <= depth[outside].max() * 1.0001


@pytest.mark.parametrize("name", OUTSIDE_ONLY)
def test_readings_inside_the_region_are_not_looked_at(name):
    lying = np.where(REGION, 3.0, PLANE).astype(np.float32)
    np.testing.assert_array_equal(REGISTRY[name](GREY, lying, REGION), REGISTRY[name](GREY, PLANE * ~REGION, REGION))


@pytest.mark.parametrize("name", NAMES)
def test_no_region_means_holes_only(name):
    depth = np.where(REGION, 0, PLANE)
    filled = REGISTRY[name](GREY, depth)
    np.testing.assert_array_equal(filled, REGISTRY[name](GREY, depth, np.zeros((H, W), bool)))
    np.testing.assert_array_equal(filled[~REGION], PLANE[~REGION])
    np.testing.assert_array_equal(REGISTRY[name](GREY, PLANE, None), PLANE)  # nothing to do


@pytest.mark.parametrize("name", KEEPING)
def test_keeping_keeps_readings_inside(name):
    depth = np.where(REGION & (U % 3 > 0), 0, PLANE)
    filled = REGISTRY[name](GREY, depth, REGION)
    np.testing.assert_array_equal(filled[depth > 0], depth[depth > 0])


def test_debiased_takes_the_bias_off_inside_only():
    bias = np.float32(baselines.TRAIN_BIAS_M)
    filled = REGISTRY["keep_and_fill_debiased"](GREY, PLANE, REGION)
    np.testing.assert_array_equal(filled, np.where(REGION, PLANE - bias, PLANE))
    flat = np.where(REGION & (V == 24), 0, np.float32(0.6)) * np.ones((H, W), np.float32)
    inside = REGION & (np.abs(U - 30) < 3)
    np.testing.assert_allclose(
        REGISTRY["keep_and_fill_debiased"](GREY, flat, REGION)[inside], 0.6 - bias, atol=5e-4
    )  # its holes are filled from the corrected readings
    tiny = np.full((H, W), 0.02, np.float32)
    assert REGISTRY["keep_and_fill_debiased"](GREY, tiny, REGION).min() > 0


def test_debiased_brings_no_reading_farther_away():
    depth = np.where(REGION, np.float32(0.004), PLANE)
    filled = REGISTRY["keep_and_fill_debiased"](GREY, depth, REGION)
    np.testing.assert_array_equal(filled, depth)  # 4 mm, and nothing nearer is left of it


@pytest.mark.parametrize("name", NAMES)
def test_region_over_everything(name):
    everything = np.ones((H, W), bool)
    if name in OUTSIDE_ONLY:
        with pytest.raises(ValueError, match="smaller region"):
            REGISTRY[name](GREY, PLANE, everything)
    else:
        assert (REGISTRY[name](GREY, PLANE, everything) > 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_bad_input_is_refused_with_advice(name):
    fill = REGISTRY[name]
    with pytest.raises(ValueError, match="no reading at all"):
        fill(GREY, np.zeros((H, W), np.float32), REGION)
    with pytest.raises(ValueError, match="rgb should be uint8"):
        fill(GREY / 255, PLANE, REGION)
    with pytest.raises(ValueError, match="rgb should be uint8"):
        fill(GREY[:-1], PLANE, REGION)
    with pytest.raises(ValueError, match="mask > 0"):
        fill(GREY, PLANE, REGION.astype(np.uint8))
    with pytest.raises(ValueError, match="millimetres"):
        fill(GREY, (1000 * PLANE).astype(np.uint16), REGION)
    with pytest.raises(ValueError, match="clean_depth"):
        fill(GREY, np.where(REGION, np.nan, PLANE), REGION)


@pytest.mark.parametrize("name", NAMES)
def test_fast_enough_at_the_working_size(name):
    rng = np.random.default_rng(0)
    depth = np.where(rng.random((192, 256)) < 0.3, 0, rng.uniform(0.5, 1, (192, 256))).astype(np.float32)
    region = np.zeros((192, 256), bool)
    region[40:150, 50:210] = True  # with the holes about 55 % unknown
    rgb = rng.integers(0, 256, (192, 256, 3), dtype=np.uint8)
    start = time.process_time()  # processor time: the machine may be busy
    filled = REGISTRY[name](rgb, depth, region)
    assert time.process_time() - start < 2.0
    kept = ~region & (depth > 0)
    assert filled[kept].tobytes() == depth[kept].tobytes()


# measure_bias


def test_bias_by_hand():
    truth = np.array([[1.0, 1.0, 0.0, 1.0]], np.float32)
    region = np.array([[True, True, True, False]])
    rgb = np.zeros((1, 4, 3), np.uint8)
    one = Sample("one", rgb, np.array([[1.02, 0.0, 9.0, 5.0]], np.float32), truth, region)
    two = Sample("two", rgb, np.array([[1.05, 1.07, 0.0, 0.5]], np.float32), truth, region)
    blank = Sample("blank", rgb, np.zeros((1, 4), np.float32), truth, region)
    unlabelled = Sample("unlabelled", rgb, one.depth)
    assert measure_bias([one, two, blank, unlabelled]) == pytest.approx((0.02 + 0.06) / 2, abs=1e-6)
    with pytest.raises(ValueError, match="training split"):
        measure_bias([blank, unlabelled])


def test_what_is_dense_already_comes_back_as_a_copy():
    depth, rgb = np.ones((6, 8), np.float32), np.zeros((6, 8, 3), np.uint8)
    for name, method in baselines.REGISTRY.items():
        assert not np.shares_memory(method(rgb, depth), depth), name
