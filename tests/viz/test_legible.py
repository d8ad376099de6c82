"""Pictures can be read at the size at which a page shows them."""

import io

import numpy as np
import pytest
from matplotlib.text import Text
from PIL import Image

from ditr_lite.viz import clouds, panels
from ditr_lite.viz.panels import DPI, Picture

LEAST_PX, WIDEST_PX = 12, 903


def crowded():
    figure = Picture(14, 2.5)
    for ax in figure.subplots(1, 5):
        ax.imshow(np.zeros((3, 4)))
        ax.set_title("a title of many words beside its neighbours", fontsize=6)
        ax.tick_params(labelsize=5)
    return figure


def test_no_word_is_smaller_than_twelve_pixels_and_no_picture_wider_than_a_page():
    figure = crowded()
    image = Image.open(io.BytesIO(figure.png()))
    assert image.width <= WIDEST_PX
    assert min(text.get_fontsize() for text in figure.findobj(Text)) * DPI / 72 >= LEAST_PX


def test_titles_of_neighbours_do_not_collide():
    figure = crowded()
    figure.png()
    boxes = [ax.title.get_window_extent() for ax in figure.axes]
    assert all(left.x1 <= right.x0 for left, right in zip(boxes, boxes[1:], strict=False))
    assert "\n" in figure.axes[0].get_title()


def test_a_title_that_fits_is_left_alone():
    figure = Picture(6, 3)
    ax = figure.subplots()
    ax.set_title("depth\n12 px missing", fontsize=14)
    figure.savefig(io.BytesIO(), format="png")
    assert ax.get_title() == "depth\n12 px missing" and ax.title.get_fontsize() == 14


@pytest.mark.parametrize("size", [6, panels.FONT, 20])
def test_type_only_grows(size):
    figure = Picture(4, 2)
    figure.subplots().set_title("t", fontsize=size)
    figure.make_legible()
    assert figure.axes[0].title.get_fontsize() == max(size, panels.FONT)


def test_clouds_of_pale_points_stand_on_a_dark_ground():
    from ditr_lite.camera import Camera

    depth, rgb = np.full((8, 8), 0.5, np.float32), np.full((8, 8, 3), 240, np.uint8)
    figure = clouds.interactive({"raw": depth}, rgb, Camera(8.0, 8.0, 4.0, 4.0, 8, 8))
    assert figure.layout.scene.bgcolor == figure.layout.paper_bgcolor == clouds.BACKGROUND
