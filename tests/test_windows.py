import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ditr_lite.windows import LEAST, MARGIN, MOST, Window, choose_windows, square

SHAPES = st.tuples(st.integers(1, 120), st.integers(1, 120))


def blobs(shape, *boxes):
    region = np.zeros(shape, bool)
    for top, left, bottom, right in boxes:
        region[top:bottom, left:right] = True
    return region


# --- one window -------------------------------------------------------------------------------------------------------


def test_a_window_is_twice_as_wide_as_what_it_holds_and_about_it():
    window = square(np.array([40, 60, 70, 80]), (200, 240))
    assert window == Window(25, 40, 60) and MARGIN == 2


def test_a_small_thing_has_a_window_of_the_least_size_and_a_large_one_of_the_whole_frame():
    assert square(np.array([50, 60, 52, 62]), (200, 300)).side == LEAST * 300
    assert square(np.array([0, 0, 90, 280]), (200, 300)) == Window(-50, 0, 300)


@given(st.data())
@settings(deadline=None)
def test_a_window_holds_its_box_and_stays_in_the_frame_where_it_fits(data):
    shape = data.draw(SHAPES)
    top, left = (data.draw(st.integers(0, n - 1)) for n in shape)
    box = np.array([top, left, data.draw(st.integers(top + 1, shape[0])), data.draw(st.integers(left + 1, shape[1]))])
    window = square(box, shape)
    assert window.top <= box[0] and window.left <= box[1]
    assert window.top + window.side >= box[2] and window.left + window.side >= box[3]
    for start, length in ((window.top, shape[0]), (window.left, shape[1])):
        inside = start >= 0 and start + window.side <= length
        assert inside if window.side <= length else start <= 0 and start + window.side >= length


@pytest.mark.parametrize("window", [Window(3, 5, 8), Window(-4, 2, 30), Window(-2, -3, 10)])
def test_cutting_and_pasting_are_inverse_where_the_window_covers_the_frame(window):
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 2, (20, 24)).astype(np.float32)
    cut = window.cut(depth)
    assert cut.shape == (window.side, window.side) and cut[6, 7] == depth[window.top + 6, window.left + 7]
    covered = np.zeros((20, 24), bool)
    covered[max(window.top, 0) : window.top + window.side, max(window.left, 0) : window.left + window.side] = True
    out, where = np.zeros_like(depth), rng.random(depth.shape) < 0.5
    window.paste(cut, out, where)
    assert np.array_equal(out, np.where(covered & where, depth, 0))


def test_beyond_the_frame_colour_repeats_and_all_else_is_nothing():
    window = Window(-3, -2, 12)
    rgb = np.random.default_rng(0).integers(1, 255, (8, 9, 3), np.uint8)
    cut = window.cut(rgb)
    assert (cut[:3, 2:11] == rgb[0]).all() and (cut[11, 2:11] == rgb[-1]).all() and (cut[3:11, 0] == rgb[:, 0]).all()
    for image in (np.ones((8, 9), np.float32), np.ones((8, 9), bool)):
        part = window.cut(image)
        assert part.sum() == 72 and part[3:11, 2:11].all() and part.dtype == image.dtype


# --- choosing ---------------------------------------------------------------------------------------------------------


@given(st.integers(0, 10**6), st.integers(0, 40), SHAPES)
@settings(deadline=None, max_examples=60)
def test_every_pixel_of_a_region_is_painted_by_exactly_one_window_that_holds_it(seed, count, shape):
    rng = np.random.default_rng(seed)
    region = np.zeros(shape, bool)
    for _ in range(count):
        y, x = rng.integers(0, shape[0]), rng.integers(0, shape[1])
        region[y : y + rng.integers(1, 9), x : x + rng.integers(1, 9)] = True
    placed = choose_windows(region)
    assert len(placed) <= MOST
    painted = sum((pixels.astype(int) for _, pixels in placed), np.zeros(shape, int))
    assert np.array_equal(painted, region.astype(int))
    for window, pixels in placed:
        rows, columns = np.nonzero(pixels)
        assert rows.size and window.top <= rows.min() and rows.max() < window.top + window.side
        assert window.left <= columns.min() and columns.max() < window.left + window.side


def test_far_things_have_their_own_window_and_near_specks_share_one():
    region = blobs((200, 300), (20, 20, 60, 60), (120, 220, 160, 260), (35, 63, 37, 65))
    placed = choose_windows(region)
    assert len(placed) == 2
    assert placed[0][1][36, 64] != placed[1][1][36, 64]
    home = next(pixels for _, pixels in placed if pixels[36, 64])
    assert home[30, 30]


def test_more_things_than_windows_join_the_nearest_one():
    boxes = [(20 + 90 * i, 20 + 90 * j, 50 + 90 * i, 50 + 90 * j) for i in range(4) for j in range(4)]
    region = blobs((400, 400), *boxes)
    placed = choose_windows(region)
    assert len(placed) == MOST and sum(int(p.sum()) for _, p in placed) == region.sum()
    assert len(choose_windows(region, most=2)) == 2


def test_no_region_needs_no_window():
    assert choose_windows(np.zeros((30, 40), bool)) == []
