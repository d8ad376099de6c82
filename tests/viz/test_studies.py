import numpy as np
import pytest

from ditr_lite.data import Sample
from ditr_lite.viz import panels
from ditr_lite.viz import studies as ablation_plots


def axes():
    return panels.Picture(3, 2).subplots()


def test_intervals_are_coloured_by_what_they_exclude():
    ax = axes()
    rows = {"worse": (0.002, 0.001, 0.003), "better": (-0.002, -0.003, -0.001), "neither": (0, -0.001, 0.001)}
    ablation_plots.intervals(ax, rows | {"empty": None}, "mm", "title")
    lines = [line for line in ax.lines if line.get_marker() == "None" and line.get_linestyle() == "-"]
    assert [line.get_color() for line in lines] == [panels.OKABE_ITO[5], panels.OKABE_ITO[2], panels.GREY]
    np.testing.assert_allclose([line.get_xdata() for line in lines], [[1, 3], [-3, -1], [-1, 1]])
    assert [text.get_text() for text in ax.get_yticklabels()] == [*rows, "empty"]
    assert ax.yaxis_inverted()  # the first row on top


def test_levels_have_no_zero_line_and_one_colour():
    ax = axes()
    ablation_plots.intervals(ax, {"a": (2, 1, 3)}, "m", scale=1, zero=False)
    assert len(ax.lines) == 2 and {line.get_color() for line in ax.lines} == {panels.OKABE_ITO[4]}


def test_marked_frames_stand_out_and_all_are_drawn_in_millimetres():
    ax = axes()
    ablation_plots.scatter(ax, [1, 2, 3], [0.01, 0.02, 0.03], [False, True, False], "x", "title")
    plain, marked = (c.get_offsets().data for c in ax.collections)
    np.testing.assert_allclose(plain, [[1, 10], [3, 30]])
    np.testing.assert_allclose(marked, [[2, 20]])


def test_each_figure_of_a_scene_has_its_panel_and_the_correlations_one():
    described = {f"s{k}": {"size": k, "share": -k, "objects": 1} for k in range(4)}
    errors = {name: 0.01 * d["size"] for name, d in described.items()}
    rho = {"size": (1, 0.9, 1), "share": (-1, -1, -0.9), "objects": None}
    figure = ablation_plots.against_scene(errors, described, rho, ["s3"])
    *panels_, last = figure.axes
    assert [ax.get_title() for ax in panels_] == list(rho)
    plain, marked = (c.get_offsets().data for c in panels_[1].collections)
    np.testing.assert_allclose(plain, [[0, 0], [-1, 10], [-2, 20]])
    np.testing.assert_allclose(marked, [[-3, 30]])
    assert [text.get_text() for text in last.get_yticklabels()] == list(rho) and figure.png()


def scenes(count):
    region = np.zeros((12, 16), bool)
    region[3:8, 4:9] = True
    truth = np.full((12, 16), 0.6, np.float32)
    sample = Sample("s", np.zeros((12, 16, 3), np.uint8), truth, truth, region)
    return [sample] * count, [truth + np.float32(0.02)] * count, [f"scene {k}" for k in range(count)], [region] * count


def test_the_worst_scenes_stand_in_rows_with_their_titles():
    figure = ablation_plots.worst_scenes(*scenes(3), columns=2)
    titles = [ax.get_title() for ax in figure.axes if ax.get_title()]
    assert titles == ["scene 0", "scene 1", "scene 2"]
    shown = [ax.images[0].get_array() for ax in figure.axes if ax.images and ax.images[0].get_array().ndim == 2]
    shown = [a for a in shown if a.shape == (12, 16)]
    assert len(shown) == 3 and np.ma.count(shown[0]) == 25 and shown[0].mean() == pytest.approx(20, rel=1e-3)
    assert len(figure.legends) == 1 and all(ax.get_legend() is None for ax in figure.axes)
    assert figure.png()


def test_lists_of_different_lengths_are_refused():
    samples, depths, titles, found = scenes(2)
    with pytest.raises(ValueError, match="as many of each"):
        ablation_plots.worst_scenes(samples, depths[:1], titles, found)
    with pytest.raises(ValueError, match="as many of each"):
        ablation_plots.worst_scenes([], [], [], [])


def test_stage_one_has_a_panel_of_its_own():
    figure = ablation_plots.training_curves({"optical": [(1, 0.05), (2, 0.04)], "region": [(5, 0.5), (9, 0.6)]})
    left, right = figure.axes
    np.testing.assert_allclose(left.lines[0].get_xydata(), [[1, 5], [2, 4]])
    np.testing.assert_allclose(right.lines[0].get_xydata(), [[5, 0.5], [9, 0.6]])
    assert ablation_plots.training_curves({}).png()  # no part has a curve


def test_the_surest_pixels_are_drawn_kind_by_kind_and_the_oracle_dotted():
    curve = [0.5, 1.0], [0.01, 0.02]
    kinds = {"optical": {"spread": curve, "calibrated": curve, "oracle": curve}, "kept": {"calibrated": curve}}
    figure = ablation_plots.surest_kept(kinds)
    optical, kept = figure.axes
    assert [line.get_linestyle() for line in optical.lines] == ["-", "-", ":"]
    assert optical.lines[1].get_color() == kept.lines[0].get_color() != optical.lines[0].get_color()
    np.testing.assert_allclose(kept.lines[0].get_xydata(), [[50, 10], [100, 20]])
    assert [text.get_text() for text in figure.legends[0].texts] == ["spread", "calibrated", "oracle"]
