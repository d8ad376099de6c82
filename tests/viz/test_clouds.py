import json

import numpy as np
import pytest

from ditr_lite.data import list_samples, load_sample
from ditr_lite.viz import clouds

SCENE = load_sample(list_samples("val")[0])
MAPS = {"raw": SCENE.depth, "truth": SCENE.depth_gt}


def test_points_are_metres_right_away_and_up_with_their_own_colours():
    points, colours = clouds.points_of(SCENE.depth_gt, SCENE.rgb, SCENE.camera, 10**6)
    assert len(points) == (SCENE.depth_gt > 0).sum() == len(colours)
    v, u = np.nonzero(SCENE.depth_gt > 0)
    k = len(points) // 3
    z = SCENE.depth_gt[v[k], u[k]]
    y_down = (v[k] - SCENE.camera.cy) * z / SCENE.camera.fy
    np.testing.assert_allclose(points[k], [(u[k] - SCENE.camera.cx) * z / SCENE.camera.fx, z, -y_down], rtol=1e-5)
    assert np.array_equal(colours[k], SCENE.rgb[v[k], u[k]])


@pytest.mark.parametrize("limit", [1, 50, 3000])
def test_thinning_keeps_to_its_limit_and_to_valid_pixels(limit):
    points, colours = clouds.points_of(SCENE.depth, SCENE.rgb, SCENE.camera, limit)
    assert limit / 4 <= len(points) <= limit and len(colours) == len(points) and (points[:, 1] > 0).all()


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="rgb should be"):
        clouds.points_of(SCENE.depth, SCENE.rgb[:-1], SCENE.camera)
    with pytest.raises(ValueError, match="max_points"):
        clouds.points_of(SCENE.depth, SCENE.rgb, SCENE.camera, 0)


def test_the_interactive_figure_is_small_offline_and_plain_json():
    shown = clouds.Interactive(clouds.interactive(MAPS, SCENE.rgb, SCENE.camera, 2000))
    bundle = shown._repr_mimebundle_()
    assert set(bundle) == {clouds.MIME, "text/plain"} and "raw, truth" in bundle["text/plain"]
    text = json.dumps(bundle)
    assert len(text) < 150_000 and "http" not in text and "<script" not in text
    figure = bundle[clouds.MIME]
    assert [trace["name"] for trace in figure["data"]] == ["raw", "truth"]
    assert figure["layout"]["scene"]["xaxis"]["range"] == figure["layout"]["scene2"]["xaxis"]["range"]


def test_the_picture_shows_both_clouds_in_one_frame():
    figure = clouds.static({**MAPS, "nothing": np.zeros_like(SCENE.depth)}, SCENE.rgb, SCENE.camera)
    assert figure.png()[:4] == b"\x89PNG"
    first, second, empty = figure.axes
    assert first.get_xlim() == second.get_xlim() == empty.get_xlim() and first.get_title() == "raw"


def test_the_palette_stays_near_the_colours():
    colours = SCENE.rgb[::7, ::7].reshape(-1, 3)
    index, scale = clouds._palette(colours)
    table = np.array([[int(c) for c in name[4:-1].split(",")] for _, name in scale])
    assert len(scale) <= 48 and scale[0][0] == 0 and scale[-1][0] == 1 and index.max() < len(scale)
    assert np.abs(table[index] - colours.astype(int)).mean() < 8
    assert len(clouds._palette(colours[:0])[0]) == 0 and len(clouds._palette(colours[:1])[1]) >= 2
