"""Loss types: labels, and the paper's partition."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ditr_lite.loss_types import LossType, label, partition

# label


def test_label_names_each_kind_and_uses_both_thresholds():
    depth = np.array([[1.0, 1.019, 1.021, 0.0], [0.309, 0.311, 0.5, 0.0]], np.float32)
    truth = np.array([[1.0, 1.0, 1.0, 1.0], [0.3, 0.3, 0.0, 0.3]], np.float32)
    region = np.array([[False] * 4, [True] * 4])
    expected = [
        [LossType.OUTSIDE_FINE, LossType.OUTSIDE_FINE, LossType.OUTSIDE_WRONG, LossType.OUTSIDE_MISSING],
        [LossType.INSIDE_FINE, LossType.INSIDE_WRONG, LossType.UNKNOWN, LossType.INSIDE_MISSING],
    ]
    codes = label(depth, truth, region)
    assert codes.dtype == np.uint8
    np.testing.assert_array_equal(codes, expected)


def test_label_of_the_truth_itself_is_fine():
    truth = np.random.default_rng(0).uniform(0.3, 2.0, (6, 7)).astype(np.float32)
    region = truth > 1
    np.testing.assert_array_equal(label(truth, truth, region), np.where(region, 3, 0))


# partition (Eq. 1, 2)


@settings(deadline=None)
@given(
    arrays(np.uint8, (5, 6, 3)), arrays(np.float32, (5, 6), elements=st.floats(0, 4, width=32)), arrays(bool, (5, 6))
)
def test_partition_is_complete_and_disjoint(rgb, depth, region):
    parts = partition(rgb, depth, region)
    whole_rgb, whole_depth = parts.union()
    np.testing.assert_array_equal(whole_rgb, rgb)
    np.testing.assert_array_equal(whole_depth, depth)
    assert not ((parts.depth_op > 0) & (parts.depth_geo > 0)).any()
    assert not parts.rgb_op[~region].any() and not parts.rgb_geo[region].any()
    assert not parts.depth_op[~region].any() and not parts.depth_geo[region].any()
    assert parts.rgb_op.dtype == rgb.dtype and parts.depth_op.dtype == np.float32


# reproject


# bad input


def test_bad_input_is_refused_with_advice():
    depth, region = np.ones((4, 5), np.float32), np.zeros((4, 5), bool)
    with pytest.raises(ValueError, match="millimetres"):
        label(np.ones((4, 5), np.uint16), depth, region)
    with pytest.raises(ValueError, match="clean_depth"):
        label(np.full((4, 5), np.nan, np.float32), depth, region)
    with pytest.raises(ValueError, match="mask > 0"):
        label(depth, depth, region.astype(np.uint8))
    with pytest.raises(ValueError, match="depth_gt should have shape"):
        label(depth, depth.T, region)
    with pytest.raises(ValueError, match="rgb should be"):
        partition(np.zeros((4, 5), np.uint8), depth, region)
