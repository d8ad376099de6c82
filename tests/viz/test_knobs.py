"""Knobs: a static row without a front end, sliders that redraw with one, and no widget imported before it is needed."""

import io
import subprocess
import sys

import ipywidgets
import pytest
from PIL import Image

from ditr_lite.viz.knobs import FRONT_ENDS, front_end, knobs
from ditr_lite.viz.panels import Picture

VALUES = {"slope": (0.5, 1.0, 2.0), "offset": (0, 1)}
ROW = [{"slope": 0.5, "offset": 1}, {"slope": 2.0, "offset": 0}]


def line(ax, slope, offset):
    ax.plot([0, 1], [offset, offset + slope])
    ax.set_title(f"slope {slope}, offset {offset}")


@pytest.fixture
def no_front_end(monkeypatch):
    for name in FRONT_ENDS:
        monkeypatch.delenv(name, raising=False)


def test_without_a_front_end_every_setting_is_drawn_in_one_row(no_front_end):
    picture = knobs(line, VALUES, ROW)
    assert isinstance(picture, Picture)
    assert [ax.get_title() for ax in picture.axes] == ["slope 0.5, offset 1", "slope 2.0, offset 0"]
    assert len({ax.get_subplotspec().rowspan.start for ax in picture.axes}) == 1


@pytest.mark.parametrize("name", FRONT_ENDS)
def test_a_front_end_is_recognised_by_its_trace(no_front_end, monkeypatch, name):
    assert not front_end()
    monkeypatch.setenv(name, "1")
    assert front_end()
    assert isinstance(knobs(line, VALUES, ROW), ipywidgets.VBox)


def test_sliders_start_at_the_first_setting_and_redraw():
    slope, offset, image, still = knobs(line, VALUES, ROW, live=True).children
    assert (slope.value, offset.value) == (0.5, 1) and [v for _, v in slope.options] == [0.5, 1.0, 2.0]
    assert slope.tooltip == "slope: move to draw again"
    before = image.value
    assert Image.open(io.BytesIO(before)).format == "PNG"
    slope.value = 2.0
    assert image.value != before
    slope.value = 0.5
    assert image.value == before
    assert still.value == knobs(line, VALUES, ROW, live=False).png()  # the row stands below, and stays


def test_panels_of_one_setting_lie_beneath_each_other_in_the_row_and_beside_each_other_with_sliders():
    seen = []

    def two(axes, slope, offset):
        seen.append([(ax.get_subplotspec().rowspan.start, ax.get_subplotspec().colspan.start) for ax in axes])

    knobs(two, VALUES, ROW, panels=2, live=False)
    knobs(two, VALUES, ROW, panels=2, live=True)
    row = [[(0, 0), (1, 0)], [(0, 1), (1, 1)]]
    assert seen == [*row, *row, [(0, 0), (0, 1)]]  # without sliders the row; with them the row and what they move


def test_the_static_row_loads_no_widgets():
    code = (
        "import sys; from ditr_lite.viz.knobs import knobs; "
        "knobs(lambda ax, k: None, {'k': [1]}, [{'k': 1}], live=False);"
        "assert 'ipywidgets' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    "values, row, message",
    [
        (VALUES, [], "at least one setting"),
        (VALUES, [{"slope": 0.5}], "should name the knobs"),
        (VALUES, [{"slope": 0.7, "offset": 0}], "slope = 0.7 is not among its values"),
    ],
)
def test_settings_that_do_not_fit_are_refused(values, row, message):
    with pytest.raises(ValueError, match=message):
        knobs(line, values, row)
