import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ditr_lite.config import StdConfig
from ditr_lite.metrics import expected_error
from ditr_lite.pipeline import compose

SHAPE = (5, 7)
METRES = st.floats(0.0625, 8, width=32)
RAW = arrays(np.float32, SHAPE, elements=st.just(0.0) | METRES)
DENSE = arrays(np.float32, SHAPE, elements=METRES)
REGION = arrays(bool, SHAPE)


@settings(deadline=None)
@given(RAW, DENSE, DENSE, REGION)
def test_composition_follows_the_rule_pixel_by_pixel(depth, optical, geometric, region):
    out = compose(depth, optical, geometric, region)
    for place in np.ndindex(SHAPE):  # Sec. IV-A, one sentence after the other
        if region[place]:
            assert out[place] == optical[place]  # inside the mask, the depth values are re-estimated
        elif depth[place] == 0:
            assert out[place] == geometric[place]  # outside, the missing depth values are re-generated
        else:
            assert out[place].tobytes() == depth[place].tobytes()  # and the original depth values are kept
    assert out.dtype == np.float32 and (out > 0).all()


@settings(deadline=None)
@given(RAW, DENSE, REGION)
def test_a_single_painting_is_composed_by_the_same_rule(depth, filled, region):
    out = compose(depth, filled, filled, region)  # how baselines are composed
    kept = ~region & (depth > 0)
    assert out[kept].tobytes() == depth[kept].tobytes() and out[~kept].tobytes() == filled[~kept].tobytes()


def test_expected_error_adds_a_share_of_the_depth_to_the_scaled_spread():
    spread, depth = np.array([[0.03, 0.03, 0.0]]), np.array([[0.5, 0.5, 0.8]], np.float32)
    region, kept = np.array([[True, False, False]]), np.array([[False, False, True]])
    doubt = np.zeros((1, 3))
    plain = expected_error(spread, depth, kept, region, doubt, StdConfig())
    assert np.allclose(plain, [[0.03, 0.03, 0]]) and plain.dtype == np.float32
    fitted = expected_error(spread, depth, kept, region, doubt, StdConfig(base=(0.08, 0), factor=(1, 3)))
    assert np.allclose(fitted, [[0.05, 0.09, 0]])
    single = expected_error(0 * spread, depth, kept, region, doubt, StdConfig(base=(0.08, 0.1), factor=(2, 2)))
    assert np.allclose(single, [[0.04, 0.05, 0]])  # of one sample there is no spread


def test_a_kept_reading_is_as_sure_as_stage_one_is_of_no_glass():
    depth, nothing = np.full((1, 3), 2.0, np.float32), np.zeros((1, 3), bool)
    doubt = np.array([[0.0, 0.25, 1.0]])
    error = expected_error(0 * depth, depth, ~nothing, nothing, doubt, StdConfig(kept=0.03, missed=0.08))
    assert np.allclose(error, 2 * np.sqrt(0.03**2 + doubt * 0.08**2))
