"""Pictures of what passes between the parts: one panel for each thing, and the numbers that are handed over."""

import numpy as np
import torch

from ditr_lite.conditioning import CHANNELS, Bounds
from ditr_lite.viz import stages
from ditr_lite.windows import Window, fit_frame


def titles(figure):
    return [ax.get_title() for ax in figure.axes if ax.get_title()]


def test_each_window_has_a_panel_and_its_square_in_the_frame():
    image, region = np.zeros((40, 60, 3), np.uint8), np.zeros((40, 60), bool)
    region[10:14, 20:26] = True
    window = Window(6, 17, 12)
    shown = np.zeros((24, 24, 3), np.uint8), np.zeros((24, 24), np.float32), np.ones((24, 24), bool)
    figure = stages.frame_and_windows(image, region, [(window, region, fit_frame((12, 12), (24, 24)), shown)] * 2)
    assert titles(figure) == ["frame and windows", *["12 px wide,\nshown with 24"] * 2]
    squares = [line.get_xydata() for line in figure.axes[0].lines]
    assert len(squares) == 2 and squares[0].min(0).tolist() == [17, 6] and squares[0].max(0).tolist() == [29, 18]
    assert stages.frame_and_windows(image, region, []).png()  # a frame without a region


def test_evidence_is_drawn_as_what_a_fill_that_believes_it_would_add():
    image = torch.zeros(len(CHANNELS), 8, 8)
    image[CHANNELS.index("evidence")] = 0.2
    image[CHANNELS.index("boundary"), 2] = 1
    bounds, filled = Bounds(0.5, 1.0), torch.zeros(1, 8, 8)
    figure = stages.draw_given({"optical": (image, filled, torch.full((1, 2, 2), 0.25), bounds)}, (0.5, 1.0))
    guide, unknown, start, evidence = (np.asarray(ax.images[0].get_array()) for ax in figure.axes[:4])
    assert (guide == image[CHANNELS.index("boundary")].numpy()).all() and (unknown == 0.75).all()
    middle, farther = bounds.denormalise(np.zeros(1))[0], bounds.denormalise(np.full(1, 0.2))[0]
    np.testing.assert_allclose(start, middle, rtol=1e-5)
    np.testing.assert_allclose(evidence, 1000 * (farther - middle), rtol=1e-4)


def test_latents_are_drawn_channel_by_channel():
    figure = stages.draw_latents({"start": torch.zeros(4, 6, 6), "target": torch.ones(4, 6, 6)}, 1.0)
    assert titles(figure) == [f"{name}, channel {k}" for name in ("start", "target") for k in range(4)]


def test_steps_stand_beside_each_other_with_their_predictions_and_errors_below():
    plane, truth = torch.zeros(6, 6), np.ones((24, 24), np.float32)
    where, steps = np.zeros(truth.shape, bool), {1: (plane, truth + 0.05, "first"), 8: (plane, truth, "last")}
    where[:6] = True
    figure = stages.draw_steps(steps, 1.0, truth, where)
    above, middle = (f"{what} step" for what in ("latents after", "depth predicted in"))
    assert titles(figure) == [f"{above} 1", f"{above} 8", f"{middle} 1", f"{middle} 8", "first", "last"]
    shown = figure.axes[4].images[0].get_array()
    np.testing.assert_allclose(shown[where], 50, atol=1e-3)
    assert shown.mask[~where].all()


def test_a_probability_is_drawn_from_0_to_1():
    figure = stages.Picture(4, 3)
    stages.draw_probability(figure.subplots(), np.full((4, 6), 0.3))
    assert figure.axes[0].images[0].get_clim() == (0, 1)
