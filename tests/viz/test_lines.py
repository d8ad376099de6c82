"""viz.lines: what is drawn, in which colours, and with which words."""

import numpy as np
import pytest

from ditr_lite import viz
from ditr_lite.viz import lines as lines_of_viz
from ditr_lite.viz import panels


def axes():
    return panels.Picture(3, 2).subplots()


def test_lines_have_their_names_colours_and_places():
    ax = axes()
    viz.curves(ax, {"a": ([1, 2], [3, 4]), "b": np.array([5, 6, 7])}, "x (m)", "y (mm)", "o--", title="t", ylim=(0, 9))
    first, second = ax.lines
    assert [line.get_label() for line in ax.lines] == ["a", "b"] == [t.get_text() for t in ax.get_legend().texts]
    assert [line.get_color() for line in ax.lines] == [panels.OKABE_ITO[4], panels.OKABE_ITO[5]]
    np.testing.assert_allclose(first.get_xydata(), [[1, 3], [2, 4]])
    np.testing.assert_allclose(second.get_xydata(), [[0, 5], [1, 6], [2, 7]])  # over 0, 1, 2
    assert (first.get_marker(), first.get_linestyle()) == ("o", "--")
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_title()) == ("x (m)", "y (mm)", "t") and ax.get_ylim() == (0, 9)


def test_one_line_needs_no_legend_and_brings_its_own_colour():
    ax = axes()
    viz.curves(ax, {"a": [1, 2]}, "x", colours=("black",))
    assert ax.get_legend() is None and ax.lines[0].get_color() == "black"


def test_a_picture_of_one_panel():
    figure = viz.plot({"a": [1, 2], "b": [2, 1]}, "x", "y", (4, 2), xscale="log")
    (ax,) = figure.axes
    assert tuple(figure.get_size_inches()) == (4, 2) and ax.get_xscale() == "log" and len(ax.lines) == 2


def test_more_lines_than_colours_are_refused():
    lines = {str(k): [0, k] for k in range(1 + len(lines_of_viz.COLOURS))}
    with pytest.raises(ValueError, match="at most 6 lines.*got 7"):
        viz.curves(axes(), lines, "x")
