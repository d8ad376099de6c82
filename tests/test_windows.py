import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_scenes import table

from ditr_lite.windows import (
    LEAST,
    MARGIN,
    MOST,
    RIM,
    Layer,
    Painting,
    Window,
    box_around,
    choose_windows,
    close_ups,
    fit_frame,
    largest_piece,
    level,
    pool_readings,
    square,
    tie,
)

SIZES = st.tuples(st.integers(1, 300), st.integers(1, 300))
SHAPES = st.tuples(st.integers(1, 120), st.integers(1, 120))


def blobs(shape, *boxes):
    region = np.zeros(shape, bool)
    for top, left, bottom, right in boxes:
        region[top:bottom, left:right] = True
    return region


# --- into the working size and back -----------------------------------------------------------------------------------


@settings(deadline=None)
@given(SIZES)
def test_any_size_fits_with_its_aspect_and_comes_back(source):
    frame = fit_frame(source, (64, 96))
    assert 1 <= frame.height <= 64 and 1 <= frame.width <= 96 and (frame.height == 64 or frame.width == 96)
    scales = frame.height / source[0], frame.width / source[1]
    assert abs(scales[0] - scales[1]) * max(source) <= max(source) / min(source) + 1  # equal but for rounding
    inside = frame.into(np.ones(source, bool))
    assert inside.shape == (64, 96) and inside.sum() == frame.height * frame.width
    for image in (np.ones(source, np.float32), np.ones(source, bool)):
        back = frame.back(frame.into(image))
        assert back.shape == source and back.dtype == image.dtype and (back == 1).all()


def test_depth_is_never_averaged_and_missing_stays_missing():
    depth = np.random.default_rng(0).choice([0, 0.5, 2.0], (120, 170)).astype(np.float32)
    frame = fit_frame(depth.shape, (64, 96))
    assert set(np.unique(frame.into(depth))) == {0, np.float32(0.5), 2}
    assert frame.into(np.full((120, 170, 3), 9, np.uint8)).shape == (64, 96, 3)


@pytest.mark.parametrize("source", [(720, 1280), (192, 256), (97, 97), (51, 51)])
def test_depth_and_masks_lie_where_colour_lies(source):
    # columns numbered in colour and in depth, and a mask of the left half; at corners they lie up to half a cell aside
    columns = np.broadcast_to(np.linspace(20, 220, source[1], dtype=np.float32), source)
    frame = fit_frame(source, (192, 256))
    inner = np.s_[: frame.height, 8 : frame.width - 8]
    cell = 200 / frame.width
    colour = frame.into(np.repeat(columns[..., None], 3, axis=2).round().astype(np.uint8))[inner][..., 0]
    depth = frame.into(columns.copy())[inner]
    assert abs(np.mean(depth - colour.astype(np.float32))) < 0.2 * cell  # colour is rounded to whole numbers
    mask = frame.into(columns < 120)[inner]
    assert abs(mask.mean() - (depth < 120).mean()) < 0.01
    # and back: what was drawn at the working size comes to lie in the middle of the frame again, in every way
    small = np.zeros((192, 256), np.float32)
    small[: frame.height, : frame.width // 2] = 1
    for image in (small, small > 0):
        assert abs(frame.back(image).mean() - (frame.width // 2) / frame.width) <= 0.5 / source[1] + 1e-6


def test_padding_repeats_the_colour_of_the_border_and_holds_no_reading():
    rgb = np.random.default_rng(0).integers(1, 256, (72, 128, 3)).astype(np.uint8)
    frame = fit_frame((72, 128), (96, 128))
    padded = frame.into(rgb)
    assert padded.shape == (96, 128, 3) and np.array_equal(padded[72:], np.repeat(rgb[-1:], 24, axis=0))
    assert (
        not frame.into(np.ones((72, 128), np.float32))[72:].any()
        and not frame.into(np.ones((72, 128), bool))[72:].any()
    )


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10**6), st.integers(1, 60))
def test_sparse_readings_survive_the_way_into_the_working_size(seed, count):
    rng = np.random.default_rng(seed)
    depth = np.zeros((240, 320), np.float32)
    at = rng.integers(0, 240, count), rng.integers(0, 320, count)
    depth[at] = rng.uniform(0.3, 3, count)
    frame = fit_frame(depth.shape, (64, 96))
    small = frame.into(depth)
    for y, x in zip(*at, strict=True):
        assert small[int((y + 0.5) * frame.height / 240), int((x + 0.5) * frame.width / 320)] > 0
    assert (small > 0).sum() <= 4 * count
    assert set(small[small > 0]) <= set(depth[depth > 0])


def test_scan_lines_survive_and_the_reading_closest_to_the_centre_counts():
    lines = np.zeros((240, 320), np.float32)
    lines[3::11] = 1.5
    assert (fit_frame(lines.shape, (64, 96)).into(lines) > 0).sum() > 20 * 80
    image, small = np.zeros((8, 8), np.float32), np.zeros((2, 2), np.float32)
    image[0, 0], image[1, 2], image[7, 7] = 1.0, 2.0, 3.0
    small[1, 0], image[6, 1] = 9.0, 4.0  # has a reading already
    pool_readings(small, image)
    assert small.tolist() == [[2, 0], [9, 3]]
    same = np.zeros((8, 8), np.float32)
    pool_readings(same, image)
    assert not same.any()  # nothing was made smaller


def test_colour_is_averaged_where_it_is_made_smaller():
    rgb = np.random.default_rng(0).integers(0, 256, (192, 288, 3), np.uint8)
    blocks = rgb.reshape(64, 3, 96, 3, 3).mean(axis=(1, 3))  # each pixel of the working size holds 3 x 3 of these
    assert np.abs(fit_frame((192, 288), (64, 96)).into(rgb) - blocks).max() <= 0.51


def test_way_back_is_smooth_on_surfaces_and_sharp_at_jumps():
    ramp = np.tile(np.linspace(1, 1.2, 96, dtype=np.float32), (64, 1))
    frame = fit_frame((128, 192), (64, 96))
    fine = frame.back(ramp)[0]
    assert np.abs(np.diff(fine, 2)).max() < 1e-3 and len(np.unique(fine)) > 150  # no staircase
    for near in (0.5, 0.9375):  # a jump of 6 cm at 1 m is one, too
        step = np.where(np.arange(96) < 48, np.float32(near), np.float32(1.0)) * np.ones((64, 1), np.float32)
        assert set(np.unique(frame.back(step))) == {near, 1}  # no flying pixel between the two


def test_at_the_working_size_a_map_comes_back_as_a_copy_of_itself():
    depth = np.random.default_rng(0).random((64, 96)).astype(np.float32)
    back = fit_frame((64, 96), (64, 96)).back(depth)
    assert np.array_equal(back, depth) and not np.shares_memory(back, depth)


def test_what_is_found_on_the_picture_never_sees_its_padding():
    frame = fit_frame((72, 128), (96, 128))
    seen = []

    def find(image, depth, factor):
        seen.append((image.shape, depth.shape))
        return depth > 0, factor * depth

    image, depth = np.ones((96, 128, 3), np.uint8), np.ones((96, 128), np.float32)
    found, scaled = frame.on_picture(find, image, depth, factor=2)
    assert seen == [((72, 128, 3), (72, 128))]
    assert found[:72].all() and not found[72:].any() and found.dtype == bool
    assert (scaled[:72] == 2).all() and not scaled[72:].any()


# --- tie --------------------------------------------------------------------------------------------------------------


def tied_to(painted, depth, region):
    """Return a painting raised to the level of the readings wherever none counts."""
    tied = painted.copy()
    tie(tied, level(painted, depth, region), (depth == 0) | region)
    return tied


def test_only_holes_are_raised_and_by_the_readings_that_count():
    depth = table()
    region = np.zeros(depth.shape, bool)
    region[10:20, 10:20] = True
    painted = np.random.default_rng(1).uniform(0.3, 1.2, depth.shape).astype(np.float32)
    tied, known = tied_to(painted, depth, region), (depth > 0) & ~region
    assert np.array_equal(tied[known], painted[known]) and tied.dtype == np.float32 and (tied > 0).all()
    assert not np.allclose(tied[~known], painted[~known])
    assert np.array_equal(tied, tied_to(painted, np.where(region, 5, depth).astype(np.float32), region))


@settings(deadline=None, max_examples=20)
@given(st.floats(0.75, 1.35))
def test_a_painting_that_is_off_by_a_ratio_is_put_right(ratio):
    depth = np.where(table() > 0, table(), 0)
    whole = np.linspace(0.9, 0.5, 48)[:, None] * np.ones((1, 64))
    depth = np.where(depth > 0, whole, 0).astype(np.float32)
    tied = tied_to((ratio * whole).astype(np.float32), depth, np.zeros(depth.shape, bool))
    assert (depth == 0).any() and np.allclose(tied[depth == 0], whole[depth == 0], rtol=1e-4)


def test_an_edge_that_is_painted_aside_does_not_move_the_hole_beside_it():
    # a thing before a wall, and the shadow of parallax on the wall beside it, in which nothing was read
    depth = np.full((48, 64), 3.0, np.float32)
    depth[:, 20:30], depth[:, 30:36] = 0.8, 0
    painted = np.full_like(depth, 3.0)
    painted[:, 20:29] = 0.8  # the last column of the thing is painted as the wall
    assert np.allclose(tied_to(painted, depth, np.zeros(depth.shape, bool))[:, 30:36], 3.0, rtol=1e-5)


def test_without_a_reading_that_counts_there_is_no_level():
    painted, region = table() + 0.5, np.zeros((48, 64), bool)
    assert level(painted, 0 * painted, region) is None and level(painted, table(), ~region) is None


def test_a_stray_reading_does_not_raise_what_is_around_it():
    depth, region = np.full((48, 64), 0.7, np.float32), np.zeros((48, 64), bool)
    depth[20:23, 30:33] = 0
    spoilt = depth.copy()
    spoilt[24, 31] = 20
    assert np.allclose(level(0 * depth + 0.7, spoilt, region), 0, atol=1e-6)


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


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("end", "windows"), [(72, 1), (73, 2), (80, 2)])
def test_a_speck_shares_a_window_unless_it_lies_in_the_tenth_at_its_border(axis, end, windows):
    thing, speck = (20, 20, 60, 60), (35, end - 2, 37, end)  # the window of the thing ends at 80
    region = blobs((300, 300), thing, speck if axis else (*speck[1::-1], *speck[:1:-1]))
    assert len(choose_windows(region)) == windows


def test_pieces_that_touch_at_a_corner_are_one():
    steps = ((20, 20, 30, 30), (30, 30, 40, 40), (40, 40, 50, 50))
    apart = (100, 100, 115, 115)  # larger than each of the steps, smaller than all of them
    region = blobs((200, 200), *steps, apart)
    assert np.array_equal(largest_piece(region), blobs((200, 200), *steps))
    (one, _), _ = choose_windows(region)
    assert one == Window(5, 5, 60)


def test_more_things_than_windows_join_the_nearest_one():
    boxes = [(20 + 90 * i, 20 + 90 * j, 50 + 90 * i, 50 + 90 * j) for i in range(4) for j in range(4)]
    region = blobs((400, 400), *boxes)
    placed = choose_windows(region)
    assert len(placed) == MOST and sum(int(p.sum()) for _, p in placed) == region.sum()
    assert len(choose_windows(region, most=2)) == 2
    corners = blobs((400, 400), (20, 20, 60, 60), (320, 320, 365, 365), (250, 250, 260, 260))
    larger, smaller = (pixels for _, pixels in choose_windows(corners, most=2))
    assert larger[340, 340] and larger[255, 255] and not smaller[255, 255]


def test_no_region_needs_no_window():
    assert choose_windows(np.zeros((30, 40), bool)) == []


def test_a_window_shows_the_region_wider_but_paints_the_region_itself():
    region = blobs((120, 160), (40, 60, 80, 100))  # its window is 80 pixels wide and shown with as many
    ((window, pixels, _, (_, _, shown)),) = close_ups(
        np.zeros((120, 160, 3), np.uint8), np.ones((120, 160), np.float32), region, 80, np.ones((120, 160))
    )
    assert window == Window(20, 40, 80) and np.array_equal(pixels, region)
    assert np.array_equal(shown, blobs((80, 80), (20 - RIM, 20 - RIM, 60 + RIM, 60 + RIM)))


def test_the_largest_piece_is_found():
    region = blobs((60, 80), (5, 5, 15, 15), (30, 30, 34, 60))
    assert (largest_piece(region) == blobs((60, 80), (30, 30, 34, 60))).all()
    assert not largest_piece(np.zeros((4, 5), bool)).any()


def test_a_box_goes_around_the_region_and_ends_with_the_frame():
    region = blobs((100, 200), (40, 60, 50, 80))  # 10 high, 20 wide: a border of 10 with the margin of one half
    assert box_around(region) == (slice(30, 60), slice(50, 90))
    assert box_around(region, margin=0) == (slice(40, 50), slice(60, 80))
    assert box_around(region, margin=5) == (slice(0, 100), slice(0, 180))
    assert box_around(np.zeros((30, 40), bool)) == (slice(0, 30), slice(0, 40))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), margin=st.floats(0, 2))
def test_no_pixel_of_the_region_is_cut_off(seed, margin):
    region = np.random.default_rng(seed).random((12, 17)) < 0.05
    assert region[box_around(region, margin)].sum() == region.sum()


# --- what was painted -------------------------------------------------------------------------------------------------


def test_a_painting_is_composed_and_its_spread_is_that_of_who_painted():
    view, region = fit_frame((4, 6), (4, 6)), np.zeros((4, 6), bool)
    region[1:3, 1:3] = True
    depth = np.where(np.arange(6) < 4, 0.7, 0).astype(np.float32) * np.ones((4, 1), np.float32)
    flat = [np.full((4, 6), v, np.float32) for v in (1.6, 0.04, 0.5, 0.02)]
    painting = Painting(Layer(*flat[:2], view), (Layer(*flat[2:], view),), None, np.packbits(region, axis=1), ())
    wanted = np.where(region, np.float32(0.5), np.where(depth > 0, depth, np.float32(1.6)))
    assert np.array_equal(painting.compose(depth, region), wanted)
    assert np.array_equal(painting.spread(region), np.where(region, np.float32(0.02), np.float32(0.04)))
