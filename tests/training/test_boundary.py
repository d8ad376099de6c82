import numpy as np
import pytest
import torch

from ditr_lite import store
from ditr_lite.boundary import get_backend, true_maps
from ditr_lite.boundary.learned import LearnedBoundary, build_nets
from ditr_lite.config import override, preset
from ditr_lite.data import SAMPLES, read_sample
from ditr_lite.training import boundary as boundary_training
from ditr_lite.training.boundary import (
    best_threshold,
    boundary_step,
    draw_crop,
    exact_outlines,
    probabilities,
    train_boundary,
)
from ditr_lite.training.loop import Recipe
from ditr_lite.training.scenes import load_scenes

VAL = SAMPLES / "val"
SHORT = Recipe(steps=3, batch=2, lr=1e-3)


@pytest.fixture(scope="module")
def scenes():
    return load_scenes(VAL, 2)


def test_outlines_are_the_exact_ones(scenes):
    found = exact_outlines(scenes)
    for i, name in enumerate(scenes.names):
        rgb, depth = true_maps(read_sample(VAL / name))
        assert np.array_equal(found["rgb"][i], rgb) and np.array_equal(found["depth"][i], depth)


class Spy(torch.nn.Module):
    """Remembers what it is shown and answers with a constant."""

    def __init__(self):
        super().__init__()
        self.level = torch.nn.Parameter(torch.tensor(0.0))

    def forward(self, x):
        self.seen = x
        return self.level.expand(x.shape[0], 1, *x.shape[2:])


@pytest.mark.parametrize("mode", ["rgb", "depth"])
def test_a_step_sees_small_windows_and_is_asked_for_what_lies_within_a_pixel(scenes, mode, monkeypatch):
    asked = {}

    def record(logits, near, known):
        asked.update(near=near, known=known)
        return (logits * 0).sum()

    monkeypatch.setattr(boundary_training.F, "binary_cross_entropy_with_logits", record)
    spy = Spy()
    boundary_step(mode, spy, scenes, SHORT)(0)
    assert spy.seen.shape == (2, 3, 96, 128) and asked["near"].shape == asked["known"].shape == (2, 1, 96, 128)
    share = float(asked["near"].mean())
    assert 0 < share < 0.2 and set(asked["near"].unique().tolist()) <= {0.0, 1.0}


@pytest.mark.parametrize("mode", ["rgb", "depth"])
def test_a_crop_shows_a_place_and_asks_about_the_same_place(scenes, mode):
    index = np.arange(192 * 256, dtype=np.float32).reshape(1, 192, 256).repeat(2, axis=0)
    mirrored = 0
    for seed in range(12):
        x, asked, known = draw_crop(mode, scenes, index, np.random.default_rng(seed))
        assert x.shape == (1, 3, 96, 128) and asked.shape == known.shape == (1, 1, 96, 128)
        step = float(asked[0, 0, 0, 1] - asked[0, 0, 0, 0])
        mirrored += step < 0
        place = asked[0, 0].long().numpy()
        assert abs(step) == 1 and (np.diff(place, axis=0) == 256).all()
        truths = [scenes.depth_gt[i].ravel()[place] > 0 for i in range(2)]
        assert any(np.array_equal(known[0, 0] > 0, t) for t in truths)
        if mode == "depth":  # readings only get lost
            raw = [scenes.depth[i].ravel()[place] > 0 for i in range(2)]
            assert any(((x[0, 1].numpy() > 0) <= r).all() for r in raw)
    assert 2 < mirrored < 10


def test_the_same_step_is_the_same_batch_again(scenes):
    for mode in ("rgb", "depth"):
        spy, shown = Spy(), []
        for step in (4, 4, 5):
            boundary_step(mode, spy, scenes, SHORT)(step)
            shown.append(spy.seen)
        assert torch.equal(shown[0], shown[1]) and not torch.equal(shown[0], shown[2])


def test_a_few_steps_lower_the_loss(scenes):
    torch.manual_seed(0)
    model = build_nets()["rgb"]
    step = boundary_step("rgb", model, scenes, SHORT)
    optimiser = torch.optim.AdamW(model.parameters(), lr=3e-3)
    losses = []
    for k in range(12):
        loss = step(k % 2)["total"]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert sum(losses[-2:]) < 0.8 * sum(losses[:2])


def test_training_and_the_backend_look_at_a_frame_alike(scenes):
    nets = build_nets().eval()
    backend, sample = LearnedBoundary(nets, {"rgb": 0.5, "depth": 0.5}), read_sample(VAL / scenes.names[0])
    for mode, image in (("rgb", sample.rgb), ("depth", sample.depth)):
        assert np.allclose(probabilities(mode, nets[mode], scenes)[0], backend.probability(image), atol=1e-3)


def test_the_best_threshold_is_found():
    true = np.zeros((30, 30), bool)
    true[:, 15] = True
    line = np.exp(-0.5 * ((np.arange(30) - 15) / 1.0) ** 2) * 0.9 + np.exp(-0.5 * (np.arange(30) - 5.0) ** 2) * 0.45
    cut, score = best_threshold([np.tile(line.astype(np.float32), (30, 1))], [true])
    assert score == 1 and cut >= 0.35  # the false line, smoothed, is under it; at a lower one it is not
    assert boundary_training.precision_recall_f(boundary_training.thin(np.tile(line, (30, 1)), 0.2), true)[2] < 0.7


def test_a_run_writes_weights_that_the_backend_loads_and_keeps_the_card(tmp_path, monkeypatch):
    monkeypatch.setattr(boundary_training, "VALIDATE", 1)
    out, config = tmp_path / "weights", override(preset("tiny"), **{"unet.heads": 1})
    store.save_part("detail", {"a": torch.zeros(1)}, config, out, {"steps": 1})
    notes = train_boundary(VAL, VAL, out, tmp_path / "work", limit=2, steps=3, batch=1)
    card = store.read_card(out)
    assert set(card["parts"]) == {"detail", "boundary"} and card["config"]["unet"]["heads"] == 1
    entry = card["parts"]["boundary"]
    assert entry["scenes"] == 2 and entry["rgb"]["steps"] == 3 and entry["depth"]["steps"] == 1
    assert notes["rgb"]["recipe"]["batch"] == 1 and "command" in entry
    backend = get_backend("learned", out)
    assert backend.thresholds["rgb"] == pytest.approx(notes["rgb"]["threshold"], abs=1e-3)
    before = (out / "boundary.safetensors").read_bytes()
    train_boundary(VAL, VAL, out, tmp_path / "work", limit=2, steps=3, batch=1)  # nothing is left to do
    assert (out / "boundary.safetensors").read_bytes() == before
    with pytest.raises(ValueError, match="boundary-rgb.checkpoint.safetensors belongs to another run"):
        train_boundary(VAL, VAL, out, tmp_path / "work", limit=1, steps=3, batch=1)


def test_without_scenes_nothing_is_trained(tmp_path):
    with pytest.raises(ValueError, match="no scenes"):
        train_boundary(tmp_path, VAL, tmp_path / "w", tmp_path / "work")
