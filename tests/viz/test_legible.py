"""Pictures can be read at the size at which a page shows them."""

import inspect
import io

import numpy as np
import pytest
from matplotlib.image import AxesImage
from matplotlib.text import Text
from PIL import Image

from ditr_lite import viz
from ditr_lite.camera import Camera
from ditr_lite.data import list_samples, load_sample
from ditr_lite.viz import clouds, drawings, knobs, panels, studies
from ditr_lite.viz.panels import DPI, Picture

LEAST_PX, WIDEST_PX, COLUMN_PX = 12, 800, 736


def crowded():
    figure = Picture(14, 2.5)
    for ax in figure.subplots(1, 5):
        ax.imshow(np.zeros((3, 4)))
        ax.set_title("a title of many words beside its neighbours", fontsize=6)
        ax.set_xlabel("a label of many words beside its neighbours", fontsize=6)
        ax.tick_params(labelsize=5)
    return figure


def saved(figure):
    return Image.open(io.BytesIO(figure.png()))


def test_no_word_is_smaller_than_twelve_pixels_and_no_picture_wider_than_a_page():
    figure = crowded()
    image = saved(figure)
    assert image.width == WIDEST_PX
    assert min(text.get_fontsize() for text in figure.findobj(Text)) * DPI / 72 >= LEAST_PX
    assert float(image.text[panels.SMALLEST_TYPE]) == round(panels.FONT * DPI / 72, 1) >= LEAST_PX


def test_a_picture_says_how_large_its_smallest_type_is():
    figure = Picture(4, 2)
    assert saved(figure).text[panels.SMALLEST_TYPE] == "0.0"  # no words
    figure.text(0.5, 0.5, "large", fontsize=24)
    assert saved(figure).text[panels.SMALLEST_TYPE] == "32.0"
    figure.subplots()  # its ticks come only when it is drawn
    assert saved(figure).text[panels.SMALLEST_TYPE] == "13.3"


def test_titles_and_labels_of_neighbours_do_not_collide():
    figure = crowded()
    figure.png()
    for words in ([ax.title for ax in figure.axes], [ax.xaxis.label for ax in figure.axes]):
        boxes = [text.get_window_extent() for text in words]
        assert all(left.x1 <= right.x0 for left, right in zip(boxes, boxes[1:], strict=False))
        assert "\n" in words[0].get_text()


def test_numbers_along_a_panel_do_not_run_into_each_other():
    figure = Picture(2.4, 2)
    ax = figure.subplots()
    ax.set(xlim=(-0.06, 0.16))
    figure.make_legible()
    low, high = ax.get_xlim()
    labels = [tick.label1 for tick in ax.xaxis.get_major_ticks() if low <= tick.get_loc() <= high]
    boxes = [label.get_window_extent() for label in labels]
    assert len(boxes) > 1 and all(left.x1 < right.x0 for left, right in zip(boxes, boxes[1:], strict=False))


def test_names_along_a_panel_are_turned_when_they_run_into_each_other():
    figure = Picture(4, 2)
    left, right = figure.subplots(1, 2)
    left.set_xticks(range(9), ["a long name"] * 9)
    right.set_xticks(range(5), list("abcde"))
    figure.make_legible()
    assert {tick.label1.get_rotation() for tick in left.xaxis.get_major_ticks()} == {25}
    assert {tick.label1.get_rotation() for tick in right.xaxis.get_major_ticks()} == {0}


def test_what_fits_and_what_is_a_formula_is_left_alone():
    figure = Picture(6, 3)
    ax = figure.subplots()
    ax.set_title("depth\n12 px missing", fontsize=14)
    formula = "$x_t = " + " + ".join("abcdefghijklmnopqrstuvwxyz" * 3) + "$"
    ax.set_xlabel(formula)
    figure.savefig(io.BytesIO(), format="png")
    assert ax.get_title() == "depth\n12 px missing" and ax.title.get_fontsize() == 14
    assert ax.get_xlabel() == formula


def test_a_legend_wider_than_its_panel_takes_more_lines_and_not_the_room_of_the_panel():
    figure = Picture(9, 2.5)
    axes = figure.subplots(1, 4)
    for ax in axes:
        viz.labels(ax, np.arange(12).reshape(3, 4) % 3, {0: "the background", 1: "reflective", 2: "transparent"})
    figure.make_legible()
    assert all(ax.get_window_extent().width > 120 for ax in axes)
    boxes = [ax.get_legend().get_window_extent() for ax in axes]
    assert all(left.x1 <= right.x0 for left, right in zip(boxes, boxes[1:], strict=False))


def test_panels_with_and_without_an_outline_are_alike():
    figure = Picture(6, 2)
    with_, without = figure.subplots(1, 2)
    for ax, mask in ((with_, np.arange(12).reshape(3, 4) > 6), (without, np.zeros((3, 4), bool))):
        viz.rgb(ax, np.zeros((3, 4, 3), np.uint8), mask)
    assert with_.get_xlim() == without.get_xlim() and with_.get_ylim() == without.get_ylim()


def test_several_panels_take_the_whole_width_and_one_what_it_asks_for():
    several, one = Picture(4.6, 2), Picture(4.6, 2)
    for figure, columns in ((several, 2), (one, 1)):
        for ax in np.atleast_1d(figure.subplots(1, columns)):
            figure.colorbar(ax.imshow(np.zeros((3, 4))), ax=ax)
        figure.make_legible()
    assert several.get_size_inches() == pytest.approx([panels.WIDTH_IN, 2 * (panels.WIDTH_IN / 4.6) ** 0.4])
    assert one.get_size_inches() == pytest.approx([4.6, 2])


@pytest.mark.parametrize("size", [6, panels.FONT, 20])
def test_type_only_grows(size):
    figure = Picture(4, 2)
    figure.subplots().set_title("t", fontsize=size)
    figure.make_legible()
    assert figure.axes[0].title.get_fontsize() == max(size, panels.FONT)


def test_clouds_of_pale_points_stand_on_a_dark_ground():
    depth, rgb = np.full((8, 8), 0.5, np.float32), np.full((8, 8, 3), 240, np.uint8)
    figure = clouds.interactive({"raw": depth}, rgb, Camera(8.0, 8.0, 4.0, 4.0, 8, 8))
    assert figure.layout.scene.bgcolor == figure.layout.paper_bgcolor == clouds.BACKGROUND


# --- every picture that viz makes -------------------------------------------------------------------------------------

SCENE = load_sample(list_samples("val")[0])
MAPS = {"raw": SCENE.depth, "a method with a long name": SCENE.depth_gt}


def one_panel(draw):
    figure = Picture(3, 2.5)
    draw(figure.subplots())
    return figure


def steps(ax, k):
    ax.plot([0, 1000], [0, k])
    ax.set_title(f"a long title that says that k = {k}")


EVERY = {
    "compare": lambda: viz.compare(SCENE, {f"method {k}": SCENE.depth for k in range(4)}),
    "row": lambda: viz.row([("rgb", SCENE.rgb, "a"), ("spread", SCENE.depth_gt, "b")], region={"true": SCENE.region}),
    "contact_sheet": lambda: viz.contact_sheet([SCENE] * 8, columns=8),
    "depth": lambda: one_panel(lambda ax: viz.depth(ax, SCENE.depth, title="raw")),
    "error": lambda: one_panel(lambda ax: viz.error(ax, SCENE.depth, SCENE.depth_gt)),
    "signed_error": lambda: one_panel(lambda ax: viz.signed_error(ax, SCENE.depth, SCENE.depth_gt)),
    "spread": lambda: one_panel(lambda ax: viz.spread(ax, SCENE.depth_gt)),
    "heat": lambda: one_panel(lambda ax: viz.heat(ax, SCENE.depth_gt, "probability", (0, 1))),
    "labels": lambda: one_panel(lambda ax: viz.labels(ax, SCENE.loss, {k: f"kind {k}" for k in range(7)})),
    "point_cloud_side": lambda: one_panel(lambda ax: viz.point_cloud_side(ax, SCENE.depth, SCENE.camera, label="raw")),
    "static": lambda: clouds.static(MAPS, SCENE.rgb, SCENE.camera),
    "system": drawings.system,
    "stage_one": drawings.stage_one,
    "autoencoder": drawings.autoencoder,
    "unet": drawings.unet,
    "knobs, row": lambda: knobs.knobs(steps, {"k": (1, 2, 3)}, [{"k": 1}, {"k": 2}, {"k": 3}], live=False),
    "intervals": lambda: one_panel(
        lambda ax: studies.intervals(ax, {"a": (0.01, 0.0, 0.02), "b": None}, "mm", "title")
    ),
    "scatter": lambda: one_panel(lambda ax: studies.scatter(ax, [1, 2], [0.1, 0.2], [True, False], "share", "title")),
    "against_scene": lambda: studies.against_scene(
        {"s": 0.1, "t": 0.2},
        {n: {f"figure {k}": k for k in range(5)} for n in "st"},
        {f"figure {k}": (0.1, 0.0, 0.3) for k in range(5)},
    ),
    "worst_scenes": lambda: studies.worst_scenes([SCENE] * 6, [SCENE.depth] * 6, list("abcdef"), [SCENE.region] * 6),
    "training_curves": lambda: studies.training_curves({n: [(1, 0.2), (2, 0.1)] for n in ("optical", "region")}),
    "surest_kept": lambda: studies.surest_kept({n: {"oracle": ([0.5, 1], [0.01, 0.02])} for n in ("optical", "kept")}),
}


@pytest.mark.parametrize("name", EVERY)
def test_every_kind_of_picture_can_be_read_in_a_room(name):
    figure = EVERY[name]()
    image = saved(figure)
    assert image.width <= WIDEST_PX
    shown = min(1, COLUMN_PX / image.width)
    assert float(image.text[panels.SMALLEST_TYPE]) * shown >= LEAST_PX
    written = [text.get_fontsize() for text in figure.findobj(Text) if text.get_text().strip()]
    assert min(written) * DPI / 72 * shown >= LEAST_PX


def test_every_function_that_draws_is_among_them():
    places = (viz.panels, viz.grids, viz.studies, clouds, drawings, knobs)
    returns = {
        name
        for place in places
        for name, thing in vars(place).items()
        if inspect.isfunction(thing) and thing.__module__ == place.__name__ and not name.startswith("_")
        if inspect.signature(thing).return_annotation in (Picture, AxesImage, "Picture")
        or "ax" in inspect.signature(thing).parameters
    }
    helpers = {"add_bar", "outline", "grid", "rgb"}  # drawn within the others
    drawn = {name.split(",")[0] for name in EVERY} | helpers
    assert returns <= drawn, returns - drawn


def test_a_saved_panel_and_a_slider_can_be_read_too(tmp_path):
    viz.save_panel(tmp_path / "p.png", SCENE.rgb, SCENE.depth, SCENE.depth_gt, SCENE.region, SCENE.depth_gt)
    image = Image.open(tmp_path / "p.png")
    shown = min(1, COLUMN_PX / image.width)
    assert float(image.text[panels.SMALLEST_TYPE]) * shown >= LEAST_PX
    box = knobs.knobs(steps, {"k": (1, 2)}, [{"k": 1}], live=True)
    for picture in box.children[-2:]:  # the one that moves, and the row below it
        image = Image.open(io.BytesIO(picture.value))
        assert image.width <= WIDEST_PX and float(image.text[panels.SMALLEST_TYPE]) >= LEAST_PX * WIDEST_PX / COLUMN_PX
