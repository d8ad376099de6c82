import json
import shutil

import pytest
import torch

from ditr_lite.config import preset
from ditr_lite.data import SAMPLES, load_sample
from ditr_lite.peers import system
from ditr_lite.peers import train as pt
from ditr_lite.pipeline import build
from ditr_lite.store import read_card, save_part
from ditr_lite.training.scenes import Pool, load_scenes

TINY = preset("tiny")
DATA = SAMPLES / "train"
NETWORKS = (*system.IDEAS, *system.SINGLE, *system.OWN)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    save_part("autoencoder", build(TINY)["autoencoder"].state_dict(), TINY, folder, {})
    return folder


@pytest.fixture(scope="module")
def pool():
    return Pool([load_scenes(DATA, 2)])


def timed(out, seconds_a_step=0.01):
    out.mkdir(exist_ok=True)
    (out / "times.json").write_text(json.dumps(dict.fromkeys(NETWORKS, seconds_a_step)))
    return out


def run(arm, folder, weights, pool, minutes=1e-4, seconds_a_step=0.01):
    out = timed(folder / "out", seconds_a_step)
    return pt.train_peers(arm, minutes, 0, pool, out, folder / "work", TINY, weights)


def test_shares_of_an_arm_add_up_to_its_time():
    assert all(sum(shares.values()) == pytest.approx(1) for shares in pt.ARMS.values())


def test_arms_are_of_one_size():
    counts = {
        name: sum(p.numel() for p in system.build_network(name, pt.peer_config()).parameters()) for name in NETWORKS
    }
    painters = [count for name, count in counts.items() if name != "detail"]
    assert max(painters) < 2 * min(painters)


@pytest.mark.parametrize("arm", ["regression", "single_latent_diffusion", "bb", "ditr"])
def test_an_arm_trains_all_its_networks_and_can_be_run_again(arm, tmp_path, weights, pool):
    entries = run(arm, tmp_path, weights, pool)
    parts = read_card(tmp_path / "out")["parts"]
    assert set(parts) == {"autoencoder", *(f"{name}-0" for name in entries)} and len(entries) == len(pt.ARMS[arm])
    assert all(entry["steps"] >= 1 and entry["scenes"] == 2 for entry in entries.values())
    assert run(arm, tmp_path, weights, pool) == entries  # nothing is trained twice
    with pytest.raises(ValueError, match="of other scenes or another time"):
        run(arm, tmp_path, weights, pool, minutes=1)


def test_an_arm_does_not_go_on_above_another_autoencoder(tmp_path, weights, pool):
    run("regression", tmp_path, weights, pool)
    torch.manual_seed(1)
    save_part("autoencoder", build(TINY)["autoencoder"].state_dict(), TINY, tmp_path / "other", {})
    with pytest.raises(ValueError, match="has the autoencoder of other weights"):
        run("bb", tmp_path, tmp_path / "other", pool)
    shutil.rmtree(tmp_path / "out")
    with pytest.raises(ValueError, match="belongs to another run, of other settings"):
        run("regression", tmp_path, tmp_path / "other", pool)


def test_steps_follow_from_the_time_of_one(tmp_path, weights, pool):
    entries = run("regression", tmp_path, weights, pool, minutes=1 / 60, seconds_a_step=0.5)
    assert entries["regression"]["steps"] == 2


def test_all_networks_are_timed_in_turn(tmp_path, pool):
    times = pt.step_times(tmp_path / "times.json", pool, TINY, build(TINY), rounds=1)
    assert set(times) == set(NETWORKS) and min(times.values()) > 0
    kept = {name: 1.0 for name in times}
    (tmp_path / "times.json").write_text(json.dumps(kept))
    assert pt.step_times(tmp_path / "times.json", pool, TINY, None) == kept


@pytest.mark.parametrize(("arm", "minutes", "reason"), [("oracle", 1, "unknown arm"), ("dp", 0, "positive number")])
def test_bad_arguments_are_refused(arm, minutes, reason, tmp_path):
    with pytest.raises(ValueError, match=reason):
        pt.train_peers(arm, minutes, 0, None, tmp_path, tmp_path)


def test_an_idea_is_shown_windows_and_frames_in_turn(pool):
    seen = []

    class Spy(torch.nn.Module):
        def losses(self, views, colour, batch, paint):
            seen.append((views.rgb.shape[2:], paint))
            return {"total": torch.zeros(())}

    loss = pt.idea_step(Spy(), None, pool, TINY, pt.get_backend("classical"))
    loss(0), loss(1)
    assert [tuple(shape) for shape, _ in seen] == [(64, 64), (64, 96)]
    assert seen[0][1].any() and seen[1][1].any()


@pytest.mark.parametrize("windows", [True, False])
def test_the_single_denoiser_learns_without_a_region(pool, monkeypatch, windows):
    seen = []
    monkeypatch.setattr(pt.recipes, "denoising_loss", lambda *a: seen.append(a) or torch.zeros(()))
    painter = pt.painter_of("geometric", build(TINY), TINY)
    loss = pt.single_step(painter, pool, TINY, pt.get_backend("classical"), windows=windows)
    loss(0)
    _, drawn, (image, filled, known), mask, *_ = seen[0]
    assert drawn.region.any() and not image[:, 6].any() and not image[:, 7:].any()  # no region, no evidence
    assert torch.equal(image[:, 5:6], drawn.valid) and mask.shape == known.shape
    assert filled.shape[2:] == ((64, 64) if windows else (64, 96))
    everywhere = torch.nn.functional.avg_pool2d(drawn.gt_known, 4)
    assert torch.equal(mask, everywhere) != windows


def test_the_best_two_peers_get_a_second_seed(tmp_path, monkeypatch):
    errors = {"regression": 0.05, "rgb_only": 0.03, "self_supervised": 0.02}
    arms, asked, validated = ("bb", *errors), [], []
    monkeypatch.setattr(pt, "train_peers", lambda arm, minutes, seed, *how: asked.append((arm, seed)))
    monkeypatch.setattr(pt.system, "load_arm", lambda folder, arm: arm)
    monkeypatch.setattr(pt, "validate", lambda arm, frames: validated.append(arm) or errors[arm])
    for _ in range(2):  # the second time the peers are known by their validation
        pt.train_all(1, [DATA], tmp_path, tmp_path / "work", arms, lambda: [], 2)
    assert asked == 2 * [*((arm, 0) for arm in arms), ("bb", 1), ("rgb_only", 1), ("self_supervised", 1)]
    assert validated == list(errors)


def test_a_validation_is_the_error_inside_the_true_region():
    frame = load_sample("val_00000")

    class Truth:
        def __call__(self, rgb, depth, region):
            class Out:
                pass

            out = Out()
            out.depth = frame.depth_gt + 0.01 * region
            return out

    assert pt.validate(Truth(), [frame]) == pytest.approx(0.01, abs=1e-4)
