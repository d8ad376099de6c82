import builtins
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from ditr_lite import camera, viz
from ditr_lite.camera import Camera
from ditr_lite.data import Sample
from ditr_lite.viz import grids, panels

SHAPE = (24, 32)


@pytest.fixture
def sample():
    rng = np.random.default_rng(0)
    gt = (0.5 + 0.01 * np.arange(24, dtype=np.float32)[:, None] + np.zeros(SHAPE, np.float32)).astype(np.float32)
    depth = gt + np.float32(0.02)
    depth[5:9, 6:12] = 0
    region = np.zeros(SHAPE, bool)
    region[4:12, 5:20] = True
    gt[:2] = 0
    rgb = rng.integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
    return Sample("test_0001", rgb, depth, gt, region, Camera(30.0, 31.0, 15.5, 11.5, 32, 24))


@pytest.fixture
def ax():
    return viz.Picture(4, 3).subplots()


def test_depth_panels_follow_the_rules(ax, sample):
    drawn = viz.depth(ax, sample.depth, (0.5, 0.7), "raw")
    assert drawn.get_cmap().name == "viridis_r" and drawn.get_clim() == (0.5, 0.7)
    assert drawn.get_interpolation() == "nearest"
    assert ax.get_title() == "raw\n24 px missing"
    assert ax.figure.axes[1].get_ylabel() == "depth (m)"
    np.testing.assert_array_equal(np.ma.getmaskarray(drawn.get_array()), sample.depth == 0)


def test_missing_pixels_are_grey_and_that_is_no_colour_of_the_map(ax, sample):
    drawn = viz.depth(ax, sample.depth, bar=False)
    colours = drawn.to_rgba(drawn.get_array())
    assert np.allclose(colours[sample.depth == 0][:, :3], to_rgb(viz.GREY), atol=0.003)
    for name in ("viridis_r", "magma", "RdBu_r"):
        ramp = matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3]
        assert np.abs(ramp - to_rgb(viz.GREY)).max(axis=1).min() > 0.1, name


def test_errors_are_in_millimetres(ax, sample):
    drawn = viz.error(ax, sample.depth, sample.depth_gt, 40, "raw")
    assert drawn.get_cmap().name == "magma" and drawn.get_clim() == (0, 40)
    assert ax.get_title() == "raw\nmean 20.0 mm\n88 px unknown"  # 24 without depth, 64 without truth
    assert ax.figure.axes[1].get_ylabel() == "|error| (mm)"
    np.testing.assert_allclose(drawn.get_array().compressed(), 20, atol=1e-3)


def test_signed_errors_are_symmetric_and_keep_their_sign(ax, sample):
    nearer = np.where(sample.depth > 0, sample.depth - np.float32(0.05), np.float32(0))
    drawn = viz.signed_error(ax, nearer, sample.depth_gt, 40)
    assert drawn.get_cmap().name == "RdBu_r" and drawn.get_clim() == (-40, 40)
    np.testing.assert_allclose(drawn.get_array().compressed(), -30, atol=1e-3)
    red, _, blue, _ = drawn.to_rgba([-30.0])[0]
    assert blue > red  # too near is blue


def test_errors_can_be_judged_in_a_mask_alone(ax, sample):
    where = np.zeros(sample.depth.shape, bool)
    where[5, :3] = True
    far = sample.depth_gt + np.float32(0.01)
    drawn = panels.error(ax, far, sample.depth_gt, where=where)
    assert ax.get_title() == "mean 10.0 mm" and drawn.get_array().mask.sum() == where.size - 3
    figure = viz.row([("error", far, ""), ("signed", far, "s")], depth_gt=sample.depth_gt, where=where)
    assert [a.get_title() for a in figure.axes[:2]] == ["mean 10.0 mm", "s"]
    with pytest.raises(ValueError, match="where should be"):
        panels.error(ax, far, sample.depth_gt, where=where[:1])


def test_error_without_any_common_pixel(ax, sample):
    viz.error(ax, np.zeros_like(sample.depth), sample.depth_gt, title="none")
    assert ax.get_title() == "none\n768 px unknown"


def test_outlines_lie_on_the_mask_and_close_at_the_border(ax, sample):
    region = np.zeros(SHAPE, bool)
    region[4:12, 5:20] = True
    region[20:, 28:] = True  # touches two borders
    viz.rgb(ax, sample.rgb, region)
    (contour,) = ax.collections
    first, second = (path.vertices for path in contour.get_paths()[0]._iter_connected_components())
    spans = sorted((v[:, 0].min(), v[:, 0].max(), v[:, 1].min(), v[:, 1].max()) for v in (first, second))
    assert spans == [(4.5, 19.5, 3.5, 11.5), (27.5, 31.5, 19.5, 23.5)]
    assert np.allclose(contour.get_edgecolor()[0][:3], to_rgb(viz.OKABE_ITO[0]))
    assert ax.get_legend() is None


def test_named_outlines_get_a_legend(ax, sample):
    viz.rgb(ax, sample.rgb, {"true": sample.region, "found": np.zeros(SHAPE, bool)})
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["true", "found"]


def test_no_legend_lies_on_the_picture_that_it_explains(sample):
    masks = {"true": sample.region, "found": ~sample.region, "refined": sample.region}
    figure = viz.row([("rgb", sample.rgb, "a"), ("depth", sample.depth, "b")], region=masks, depth_gt=sample.depth_gt)
    viz.labels(figure.axes[1], sample.region.astype(np.uint8), {0: "outside", 1: "inside"})
    figure.draw_without_rendering()
    for ax in figure.axes[:2]:
        box, picture = ax.get_legend().get_window_extent(), ax.get_window_extent()
        assert 0 <= box.y0 and box.y1 <= picture.y0 + 1  # inside the figure, below the picture


def test_numbers_without_a_unit_are_drawn_as_they_are(ax):
    values = np.linspace(-0.5, 1.5, 12).reshape(3, 4)
    drawn = viz.heat(ax, values, "belief", (0, 1))
    np.testing.assert_array_equal(drawn.get_array(), values)
    assert drawn.get_clim() == (0, 1) and ax.get_title() == "belief" and len(ax.figure.axes) == 2
    assert viz.heat(ax, values, bar=False).get_clim() == (-0.5, 1.5) and len(ax.figure.axes) == 2
    with pytest.raises(ValueError, match=r"should be \(H, W\), got \(2, 3, 4\)"):
        viz.heat(ax, np.zeros((2, 3, 4)))


def test_labels_count_what_occurs(ax):
    codes = np.zeros(SHAPE, np.uint8)
    codes[0, :5], codes[1, :3] = 2, 255
    viz.labels(ax, codes, {0: "fine", 1: "wrong", 2: "missing"}, "loss")
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["fine 760", "missing 5", "other 3"]
    with pytest.raises(ValueError, match="at most 9"):
        viz.labels(ax, codes, {k: str(k) for k in range(10)})
    with pytest.raises(ValueError, match="whole numbers"):
        viz.labels(ax, codes.astype(float), {0: "fine"})


def test_limits_are_percentiles_of_the_valid_pixels(sample):
    low, high = viz.depth_limits(sample.depth_gt)
    valid = sample.depth_gt[sample.depth_gt > 0]
    np.testing.assert_allclose((low, high), np.percentile(valid, [2, 98]))
    assert viz.depth_limits(np.zeros(SHAPE, np.float32)) == (0.0, 1.0)
    flat = np.full(SHAPE, 0.5, np.float32)
    assert viz.depth_limits(flat)[1] > viz.depth_limits(flat)[0]


def images_of(figure):
    return [(ax, ax.images[0]) for ax in figure.axes if ax.images]


def test_a_row_shares_limits_taken_from_the_truth(sample):
    outlier = sample.depth.copy()
    outlier[20, 20] = 30
    figure = viz.row([("rgb", sample.rgb, "a"), ("depth", outlier, "b"), ("depth", sample.depth_gt, "c")])
    truth = viz.row([("depth", outlier, "b"), ("depth", sample.depth_gt, "c")], depth_gt=sample.depth_gt)
    for fig, skip in ((figure, 1), (truth, 0)):
        limits = {image.get_clim() for _, image in images_of(fig)[skip:]}
        assert len(limits) == 1
    assert limits.pop() == viz.depth_limits(sample.depth_gt)
    bars = [ax for ax in figure.axes if ax.get_ylabel()]
    assert [ax.get_ylabel() for ax in bars] == ["depth (m)"]  # one for the kind, not one a panel


def test_compare_draws_every_prediction_and_its_error(sample):
    figure = viz.compare(sample, {"good": sample.depth_gt, "bad": sample.depth_gt + np.float32(0.1)})
    titles = [ax.get_title().split("\n")[0] for ax, _ in images_of(figure)]
    assert titles == ["test_0001", "raw", "good", "bad", "ground truth", "raw", "good", "bad"]
    shared = {image.get_clim() for _, image in images_of(figure)[5:]}
    assert len(shared) == 1 and np.isclose(shared.pop()[1], 100, atol=0.1)
    width, height = figure.get_size_inches()
    assert width <= panels.WIDTH_IN
    assert height < width
    figure.canvas.draw()
    left = [round(ax.get_position().x0, 3) for ax, _ in images_of(figure)]
    assert left[1:4] == left[5:], "an error stands under its depth"
    assert {label for ax in figure.findobj(Axes) if (label := ax.get_ylabel())} == {"depth (m)", "|error| (mm)"}
    bare = replace(sample, depth_gt=None, region=None)
    assert len(images_of(viz.compare(bare, {"good": sample.depth}))) == 3


def test_pictures_are_small_and_speak_for_themselves_in_a_notebook(sample):
    figure = viz.compare(sample, {f"method {k}": sample.depth for k in range(4)})
    bundle = figure._repr_mimebundle_()
    assert len(bundle["image/png"]) < 80_000
    assert bundle["text/plain"].startswith("<Picture: test_0001; raw, 24 px missing; method 0")
    image = cv2.imdecode(np.frombuffer(figure.png(), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape[1] == int(panels.WIDTH_IN * panels.DPI) and 150 < image.shape[0] < 700


def test_a_notebook_shows_the_small_picture_even_with_the_inline_backend(sample, monkeypatch):
    shown = []
    publisher = SimpleNamespace(publish=lambda data: shown.append(data))
    monkeypatch.setattr(builtins, "get_ipython", lambda: SimpleNamespace(display_pub=publisher), raising=False)
    figure, same = (viz.row([("depth", sample.depth, "raw")]) for _ in range(2))
    formatter = pytest.importorskip("IPython.core.formatters").DisplayFormatter()
    formatter.formatters["image/png"].for_type(Figure, lambda fig: b"large")  # what the inline backend registers
    assert formatter.format(figure) == ({}, {})  # nothing beside what the figure shows itself
    assert shown == [same._repr_mimebundle_()]  # and the same figure has the same bytes


def test_drawing_leaves_pyplot_alone(sample):
    import matplotlib.pyplot as plt

    before = plt.get_fignums()
    viz.compare(sample, {"a": sample.depth}).png()
    viz.contact_sheet([sample]).png()
    assert plt.get_fignums() == before


def test_contact_sheet_shows_all_samples_and_one_bar(sample):
    samples = [replace(sample, name=f"test_{k:04d}") for k in range(4)] + [replace(sample, name="bare", depth_gt=None)]
    figure = viz.contact_sheet(samples, columns=3)
    titles = [ax.get_title().split("\n")[0] for ax, _ in images_of(figure)]
    assert titles.count("raw") == 5 and titles.count("truth") == 4
    assert {s.name for s in samples} <= set(titles)
    assert len([ax for ax in figure.axes if ax.get_ylabel() == "depth (m)"]) == 1
    with pytest.raises(ValueError, match="no samples"):
        viz.contact_sheet([])


def test_contact_sheet_can_give_each_sample_limits_of_its_own(sample):
    far = replace(sample, name="far", depth=10 * sample.depth, depth_gt=10 * sample.depth_gt)

    def limits(shared):
        shown = images_of(viz.contact_sheet([sample, far], shared=shared))
        return [image.get_clim() for ax, image in shown if ax.get_title().startswith("truth")]

    assert limits(True)[0] == limits(True)[1]
    near, distant = limits(False)
    assert distant == pytest.approx([10 * limit for limit in near], rel=1e-4)
    assert not any(ax.get_ylabel() == "depth (m)" for ax in viz.contact_sheet([sample, far], shared=False).axes)


def test_the_side_view_plots_z_against_y(ax, sample):
    n = viz.point_cloud_side(ax, sample.depth, sample.camera, mask=sample.region, label="raw")
    assert n == (sample.region & (sample.depth > 0)).sum()
    shown = np.where(sample.region, sample.depth, np.float32(0))
    points = camera.unproject(shown, sample.camera)
    np.testing.assert_allclose(ax.collections[0].get_offsets(), points[:, [2, 1]])
    low, high = ax.get_ylim()
    assert low > high  # y down
    viz.point_cloud_side(ax, sample.depth_gt, sample.camera, sample.rgb)
    assert ax.get_ylim()[0] > ax.get_ylim()[1]
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["raw"]
    np.testing.assert_allclose(
        ax.collections[1].get_facecolor()[:, :3], sample.rgb[sample.depth_gt > 0] / 255.0, atol=1e-6
    )
    assert viz.point_cloud_side(ax, sample.depth, sample.camera, max_points=100) <= 100
    assert viz.point_cloud_points is camera.unproject


def test_save_panel_writes_a_png_whole_or_not_at_all(tmp_path, sample):
    path = tmp_path / "out" / "panel.png"
    std = np.full(SHAPE, 0.002, np.float32)
    viz.save_panel(path, sample.rgb, sample.depth, sample.depth_gt, sample.region, std)
    assert 4 * 480 <= cv2.imread(str(path)).shape[1] <= 8 * 480
    before = path.read_bytes()
    with pytest.raises(ValueError, match="NaN"):
        viz.save_panel(path, sample.rgb, sample.depth, sample.depth_gt * np.nan)
    assert path.read_bytes() == before and [p.name for p in path.parent.iterdir()] == [path.name]
    viz.save_panel(path, sample.rgb, sample.depth, sample.depth_gt)
    assert path.read_bytes() != before


def test_a_strip_makes_no_endless_picture(tmp_path):
    strip = np.full((2000, 4), 0.5, np.float32)
    rgb_, region = np.zeros((2000, 4, 3), np.uint8), strip > 0
    region[:1000] = False
    viz.save_panel(tmp_path / "p.png", rgb_, strip, strip, region, 0.01 * strip)
    height, width = cv2.imread(str(tmp_path / "p.png")).shape[:2]
    assert width <= 1200 and height <= 1.25 * panels.DPI * (grids.TALLEST_IN + 0.5)


def test_what_cannot_be_drawn_is_refused(ax, sample):
    cases = [
        (lambda: viz.depth(ax, (sample.depth * 1000).astype(np.uint16)), "floating-point metres"),
        (lambda: viz.error(ax, sample.depth, sample.depth_gt[:5]), "should be alike"),
        (lambda: viz.rgb(ax, sample.rgb / 255.0), "uint8"),
        (lambda: viz.rgb(ax, sample.rgb, sample.region.astype(np.uint8)), "bool"),
        (lambda: viz.row([("error", sample.depth, "")]), "need depth_gt"),
        (lambda: viz.row([("heat", sample.depth, "")]), "unknown kind of panel 'heat'"),
        (lambda: viz.point_cloud_side(ax, sample.depth, sample.camera, mask=sample.region[:4]), "mask should be"),
    ]
    for draw, message in cases:
        with pytest.raises(ValueError, match=message):
            draw()


def test_no_other_module_draws():
    package = Path(viz.__file__).parents[1]
    imports = re.compile(r"^\s*(import|from) matplotlib", re.MULTILINE)
    drawing = [p for p in package.rglob("*.py") if imports.search(p.read_text(encoding="utf-8"))]
    assert {p.relative_to(package).as_posix() for p in drawing} == {
        *("viz/drawings.py", "viz/grids.py", "viz/lines.py", "viz/panels.py", "viz/studies.py")
    }


@pytest.mark.parametrize("width", [240, 480])
def test_every_map_of_a_saved_panel_is_wide_enough_and_outlined(tmp_path, sample, width):
    std = np.full(sample.depth.shape, 0.01, np.float32)
    maps = (sample.rgb, sample.depth, sample.depth_gt)
    viz.save_panel(tmp_path / "with.png", *maps, sample.region, std, width=width)
    viz.save_panel(tmp_path / "without.png", *maps, np.zeros_like(sample.region), std, width=width)
    with_, without = (cv2.imread(str(tmp_path / f"{name}.png")).astype(int) for name in ("with", "without"))
    assert with_.shape == without.shape and with_.shape[1] >= 4 * width
    changed = np.abs(with_ - without).max(axis=2) > 60
    quarters = np.array_split(changed, 4, axis=1)
    assert all(quarter.sum() > 50 for quarter in quarters)


def test_spreads_in_one_row_share_their_limits_and_their_bar():
    small, large = (np.full(SHAPE, metres, np.float32) for metres in (0.001, 0.1))
    figure = viz.row([("spread", small, "a"), ("spread", large, "b")])
    limits = [image.get_clim() for ax in figure.axes[:2] for image in ax.images]
    assert limits[0] == limits[1] == pytest.approx((0, 100))
