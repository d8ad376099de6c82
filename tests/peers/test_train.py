import json

import pytest
import torch

from ditr_lite.config import preset
from ditr_lite.data import SAMPLES
from ditr_lite.peers import networks
from ditr_lite.peers import train as pt
from ditr_lite.pipeline import build
from ditr_lite.store import read_card, save_part
from ditr_lite.training.batches import frames_in_order
from ditr_lite.training.scenes import Pool, load_scenes

TINY = preset("tiny")
DATA = SAMPLES / "train"


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    save_part("autoencoder", build(TINY)["autoencoder"].state_dict(), TINY, folder, {})
    return folder


@pytest.fixture(scope="module")
def pool():
    return Pool([load_scenes(DATA, 2)])


@pytest.fixture(scope="module")
def batch(pool):
    return next(frames_in_order(pool.groups[0], TINY.size))


def run(arm, folder, weights, minutes=1e-4, seconds_a_step=0.01):
    (folder / "out").mkdir(exist_ok=True)
    (folder / "out" / "times.json").write_text(json.dumps(dict.fromkeys([*networks.NAMES, *pt.OWN], seconds_a_step)))
    return pt.train_peers(arm, minutes, 0, DATA, folder / "out", folder / "work", 2, TINY, weights)


def test_shares_of_an_arm_add_up_to_its_time():
    assert all(sum(shares.values()) == pytest.approx(1) for shares in pt.ARMS.values())


@pytest.mark.parametrize("arm", ["regression", "single_latent_diffusion", "ditr"])
def test_an_arm_trains_all_its_networks_and_can_be_run_again(arm, tmp_path, weights):
    entries = run(arm, tmp_path, weights)
    parts = read_card(tmp_path / "out")["parts"]
    assert set(parts) == {f"{name}-0" for name in entries} and len(entries) == len(pt.ARMS[arm])
    assert all(entry["steps"] >= 1 and entry["scenes"] == 2 for entry in entries.values())
    again = run(arm, tmp_path, weights)
    assert {n: e["steps"] for n, e in again.items()} == {n: e["steps"] for n, e in entries.items()}


def test_steps_follow_from_the_time_of_one(tmp_path, weights):
    entries = run("regression", tmp_path, weights, minutes=1 / 60, seconds_a_step=0.5)
    assert entries["regression"]["steps"] == 2


def test_all_networks_are_timed_in_turn(tmp_path, pool):
    times = pt.step_times(tmp_path / "times.json", pool, TINY, build(TINY), rounds=1)
    assert set(times) == {*networks.NAMES, *pt.OWN} and min(times.values()) > 0
    kept = {name: 1.0 for name in times}
    (tmp_path / "times.json").write_text(json.dumps(kept))
    assert pt.step_times(tmp_path / "times.json", pool, TINY, None) == kept


@pytest.mark.parametrize(("arm", "minutes", "reason"), [("oracle", 1, "unknown arm"), ("dp", 0, "positive number")])
def test_bad_arguments_are_refused(arm, minutes, reason):
    with pytest.raises(ValueError, match=reason):
        pt.train_peers(arm, minutes)


def test_the_true_orientation_costs_nothing_and_a_wrong_one_does(batch):
    log = batch.truth_m.clamp(min=0.05).log()
    out = torch.zeros(2, 3, *log.shape[2:])
    out[:, 0, :, :-1], out[:, 1, :-1] = (log[..., 1:] - log[..., :-1])[:, 0], (log[..., 1:, :] - log[..., :-1, :])[:, 0]
    assert pt.orientation_loss(out, batch)["gradient_l1"] < 1e-7
    assert pt.orientation_loss(out + 0.01, batch)["gradient_l1"] > 0.005


def test_a_perfect_prediction_scores_next_to_nothing(batch):
    assert pt.depth_loss(batch.relative_error(batch.gt_n), batch)["total"] < 0.01
    assert pt.depth_loss(torch.full_like(batch.gt_n, 0.1), batch)["total"] > 1


def test_every_peer_has_a_loss_that_reaches_its_network(pool):
    for name in networks.NETS:
        net = networks.build_peer(name, TINY)
        pt.peer_step(name, net, pool, TINY)(0)["total"].backward()
        assert net.out.weight.grad.abs().sum() > 0, name


def test_the_single_denoiser_learns_without_a_region(pool, monkeypatch):
    seen = []
    monkeypatch.setattr(pt.recipes, "denoising_loss", lambda *a: seen.append(a) or torch.zeros(()))
    parts = build(TINY)
    painter = pt.painter_of("geometric", parts, TINY)
    pt.single_step(painter, pool, TINY)(0)
    _, drawn, (image, filled, known), mask, *_ = seen[0]
    assert drawn.region.any() and not image[:, 6].any() and not image[:, 7:].any()  # no region, no evidence
    assert torch.equal(image[:, 5:6], drawn.valid) and mask.shape == known.shape
    assert torch.equal(mask > 0, torch.nn.functional.max_pool2d(drawn.gt_known, 4) > 0)


def test_an_arm_may_learn_from_several_folders(tmp_path, weights):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "times.json").write_text(json.dumps({"regression": 0.01}))
    entries = pt.train_peers(
        "regression", 1e-4, 0, [DATA, SAMPLES / "val"], tmp_path / "out", tmp_path / "work", 2, TINY, weights
    )
    assert entries["regression"]["scenes"] == 4
