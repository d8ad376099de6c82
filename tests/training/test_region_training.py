import math

import numpy as np
import pytest
import torch

from ditr_lite.config import preset
from ditr_lite.region import IGNORE, RegionNet
from ditr_lite.training.batches import Scenes
from ditr_lite.training.region_training import (
    BATCH,
    EPOCHS,
    FALL,
    MOMENTUM,
    PEAK,
    WEIGHT_DECAY,
    descend,
    epoch_batches,
    known_classes,
    paper_learning_rate,
    sgd,
    train_region,
    trosnet_learning_rate,
)


def make_scenes(count, shape):
    """Tilted planes at 0.5 to 0.8 m with a bright box of glass or metal, half missing, half 5 cm too far."""
    rng = np.random.default_rng(0)
    gt = np.tile(np.linspace(500, 800, shape[1]).astype(np.uint16), (count, shape[0], 1))
    rgb, material = rng.integers(0, 120, (count, *shape, 3), np.uint8), np.zeros((count, *shape), np.uint8)
    depth = gt.copy()
    gt[:, :3] = 0  # unknown
    for k in range(count):
        top, left = (int(rng.integers(0, n // 2)) for n in shape)
        box = np.s_[k, top : top + shape[0] // 3, left : left + shape[1] // 3]
        rgb[box] += 120
        material[box] = 1 + k % 2
        depth[box] += 50
        depth[k, top : top + shape[0] // 6, left : left + shape[1] // 3] = 0
    return Scenes([f"made_{k}" for k in range(count)], rgb, depth, gt, material)


@pytest.fixture(scope="module")
def scenes():
    return make_scenes(4, (48, 64))


def net():
    torch.manual_seed(0)
    return RegionNet(preset("tiny").region)


def test_constants_are_the_papers():
    assert (EPOCHS, BATCH, MOMENTUM, WEIGHT_DECAY) == (200, 16, 0.9, 1e-4)


def test_paper_rate_is_a_cosine_times_an_exponential():
    assert paper_learning_rate(0) == PEAK and paper_learning_rate(EPOCHS) == pytest.approx(0)
    halfway = paper_learning_rate(100)
    assert halfway == pytest.approx(PEAK / 2 / math.sqrt(10))  # cosine: a half; exponential: the root of a tenth
    for epoch in (10, 60, 150):
        cosine = (1 + math.cos(math.pi * epoch / EPOCHS)) / 2
        assert paper_learning_rate(epoch, fall=0) == pytest.approx(PEAK * cosine)
        assert paper_learning_rate(epoch) / paper_learning_rate(epoch, fall=0) == pytest.approx(
            math.exp(-FALL * epoch / EPOCHS)
        )
    rates = [paper_learning_rate(e) for e in range(EPOCHS + 1)]
    assert (np.diff(rates) < 0).all()
    assert paper_learning_rate(3, 999, 10, 0.1) == paper_learning_rate(3, 0, 10, 0.1)


@pytest.mark.parametrize("epoch, epochs", [(-1, 10), (11, 10), (0, 0)])
def test_paper_rate_refuses_epochs_that_there_are_not(epoch, epochs):
    with pytest.raises(ValueError, match="expected an epoch from 0 to"):
        paper_learning_rate(epoch, epochs=epochs)


def test_trosnet_rate_is_a_line_plus_a_sine_of_period_228():
    assert trosnet_learning_rate(0, 0) == pytest.approx(0.001)
    assert trosnet_learning_rate(0, 57) == pytest.approx(0.0015)  # a quarter of the period: the crest
    assert trosnet_learning_rate(0, 171) == pytest.approx(0.0005)
    assert trosnet_learning_rate(150, 57) == pytest.approx(0.0006 + 0.0003)
    assert trosnet_learning_rate(40, 10) == pytest.approx(trosnet_learning_rate(40, 238))


def test_optimiser_is_the_papers_and_leaves_frozen_weights_out():
    model = net()
    model.encoder_rgb.requires_grad_(False)
    group = sgd(model).param_groups[0]
    assert (group["momentum"], group["weight_decay"], group["nesterov"]) == (0.9, 1e-4, False)
    assert len(group["params"]) == sum(p.requires_grad for p in model.parameters()) < len(list(model.parameters()))


def test_a_step_is_the_textbook_step():
    x = torch.nn.Parameter(torch.tensor([2.0]))
    optimiser = torch.optim.SGD([x], lr=99.0, momentum=0.9, weight_decay=0.1)
    descend(optimiser, (x**2).sum(), 0.01)  # gradient 4 + 0.1 * 2
    assert x.item() == pytest.approx(2 - 0.01 * 4.2)
    v, before = 0.9 * 4.2 + 2.1 * x.item(), x.item()
    descend(optimiser, (x**2).sum(), 0.001)
    assert x.item() == pytest.approx(before - 0.001 * v)


def test_an_epoch_sees_every_scene_once_in_an_order_of_its_own(scenes):
    orders = [np.concatenate([b.index for b in epoch_batches(scenes, 3, epoch)]) for epoch in (0, 1, 0)]
    assert all(sorted(order) == [0, 1, 2, 3] for order in orders)
    assert (orders[0] == orders[2]).all() and [len(b.index) for b in epoch_batches(scenes, 3, 0)] == [3, 1]
    assert any((orders[0] != np.concatenate([b.index for b in epoch_batches(scenes, 3, e)])).any() for e in range(1, 6))


def test_pixels_of_unknown_depth_are_not_scored(scenes):
    batch = next(epoch_batches(scenes, 4, 0))
    batch.gt_known[:, :, :5] = 0
    target = known_classes(batch)
    assert (target[:, :5] == IGNORE).all() and torch.equal(target[:, 5:], batch.material[:, 5:])


def test_training_learns_follows_the_law_and_repeats(scenes):
    model, rates = net(), []

    def law(epoch, iteration, epochs):
        rates.append((epoch, iteration, epochs))
        return 0.05

    rows = train_region(model, scenes, 8, 3, law, validate=lambda: {"eval_mode": float(not model.training)})
    assert rates == [(i // 2, i, 8) for i in range(16)]
    assert rows[-1]["total"] < 0.9 * rows[0]["total"] and rows[0]["rate"] == 0.05
    assert [r["epoch"] for r in rows] == list(range(8)) and all(r["eval_mode"] == 1 for r in rows)
    assert not model.training and {"ce", "dice", "side", "boundary", "seconds"} <= set(rows[0])
    again = net()
    train_region(again, scenes, 8, 3, lambda *_: 0.05)
    assert all(torch.equal(a, b) for a, b in zip(model.parameters(), again.parameters(), strict=True))


def test_rate_zero_changes_nothing(scenes):
    model, before = net(), net()
    train_region(model, scenes, 1, 4, lambda *_: 0.0)
    assert all(torch.equal(a, b) for a, b in zip(model.parameters(), before.parameters(), strict=True))


def test_class_weights_reach_the_loss(scenes):
    plain, heavy = (
        train_region(net(), scenes, 1, 4, lambda *_: 0.0, class_weights=w)[0] for w in ((1, 1, 1), (0.01, 1, 1))
    )
    assert plain["ce"] != heavy["ce"] and plain["dice"] == pytest.approx(heavy["dice"])


@pytest.mark.parametrize("epochs, batch", [(0, 4), (1, 0)])
def test_nothing_to_do_is_refused(scenes, epochs, batch):
    with pytest.raises(ValueError, match="at least 1"):
        train_region(net(), scenes, epochs, batch)
