import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from made_scenes import make_scenes

import ditr_lite as dl
from ditr_lite import store
from ditr_lite.config import Config, StdConfig, override, preset
from ditr_lite.data import SAMPLES, Sample, read_sample, save_sample
from ditr_lite.region import IGNORE
from ditr_lite.store import WEIGHTS, copy_weights, load_part, read_card, read_config
from ditr_lite.training import parts as module
from ditr_lite.training.batches import frames_in_order
from ditr_lite.training.loop import Recipe
from ditr_lite.training.parts import (
    PARTS,
    borrow,
    check_same_system,
    claims_in_order,
    count_scenes,
    folder_name,
    needs,
    root_mean_square,
    scene_errors,
    told_apart,
    train,
    train_on,
)
from ditr_lite.training.scenes import Pool, every, load_scenes

TINY = preset("tiny")
RECIPE = Recipe(steps=2, batch=2, lr=1e-3, warmup=1)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Three validation scenes at half their size."""
    folder = tmp_path_factory.mktemp("data")
    for name in dl.list_samples("val")[:3]:
        full = read_sample(SAMPLES / "val" / name)
        maps = {k: getattr(full, k)[::2, ::2].copy() for k in ("rgb", "depth", "depth_gt", "material", "instances")}
        save_sample(Sample(name, **maps), folder / name)
    return folder


def go(part, data, home, config=TINY, **settings):
    return train(part, config, [data], [data], home / "weights", home / "work", RECIPE, **settings)


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    """Every part after two steps."""
    home = tmp_path_factory.mktemp("home")
    return home, {part: go(part, data, home) for part in PARTS}


def test_every_part_trains_and_the_card_says_how(trained, data):
    home, notes = trained
    card = read_card(home / "weights")
    assert tuple(card["parts"]) == PARTS and card["config"]["name"] == "tiny"
    for part, entry in card["parts"].items():
        assert entry["steps"] == 2 and entry["recipe"]["batch"] == 2
        assert entry["scenes"] == {"val_00000 to val_00002": 3}
        figures = entry["curve"][-1]
        assert figures == notes[part]["curve"][-1] and figures["step"] == 2
        scored = {k: v for k, v in figures.items() if k.startswith(f"{data.name}_")}
        assert scored and all(0 <= v <= 64 for v in scored.values())


def test_what_was_trained_completes_a_frame(trained, data):
    home, _ = trained
    sample = read_sample(data / "val_00000")
    out = dl.Ditr.from_pretrained(path=home / "weights")(sample.rgb, sample.depth, steps=1, samples=1)
    assert out.depth.shape == sample.depth.shape and (out.depth > 0).all()


def test_latents_have_unit_spread_after_training(trained, data):
    home, _ = trained
    scale = load_part("autoencoder", home / "weights")["latent_scale"]
    assert scale.numel() >= 1 and not torch.equal(scale, torch.ones_like(scale))


def test_same_seed_trains_the_same_bytes(trained, data, tmp_path):
    home, notes = trained
    go("region", data, tmp_path)
    files = [folder / "weights" / "region.safetensors" for folder in (home, tmp_path)]
    assert files[0].read_bytes() == files[1].read_bytes()
    go("region", data, tmp_path / "other", seed=1)
    assert files[0].read_bytes() != (tmp_path / "other" / "weights" / "region.safetensors").read_bytes()


def test_limit_takes_the_first_scenes(data, tmp_path):
    notes = go("region", data, tmp_path, limit=2)
    assert notes["scenes"] == {"val_00000 to val_00001": 2}


def test_training_goes_on_from_given_weights(trained, data, tmp_path):
    home, notes = trained
    still = Recipe(steps=1, batch=2, lr=0.0)
    entry = train("region", TINY, [data], [data], tmp_path / "out", tmp_path, still, start=home / "weights")
    assert entry["start_sha256"] == read_card(home / "weights")["parts"]["region"]["sha256"]
    then, now = (load_part("region", folder) for folder in (home / "weights", tmp_path / "out"))
    learnt = [k for k in then if "running" not in k and "num_batches" not in k]
    assert all(torch.equal(then[k], now[k]) for k in learnt)
    assert set(read_card(tmp_path / "out")["parts"]) == set(PARTS)  # the others came along
    sample = read_sample(data / "val_00000")
    assert dl.Ditr.from_pretrained(path=tmp_path / "out")(sample.rgb, sample.depth, samples=1).depth.all()
    with pytest.raises(ValueError, match="another region setting"):
        go("region", data, tmp_path, override(TINY, **{"region.width": 16}), start=home / "weights")


def test_training_goes_on_with_the_calibration_of_given_weights(trained, data, tmp_path):
    start, refine = tmp_path / "start", replace(TINY.refine, temperature=1.5)
    copy_weights(trained[0] / "weights", start, replace(TINY, std=StdConfig(kept=0.02), refine=refine))
    go("region", data, tmp_path, override(TINY, evidence=False), start=start)
    found = read_config(tmp_path / "weights")
    assert (found.std.kept, found.refine.temperature, found.evidence) == (0.02, 1.5, False)


def test_a_checkpoint_counts_only_for_what_it_was_trained_from(trained, data, tmp_path):
    start = {"start": trained[0] / "weights"}
    go("region", data, tmp_path, **start)
    go("region", data, tmp_path, **start)  # the very same: nothing is left to do
    for other in ({}, {**start, "seed": 1}, {**start, "limit": 2}):
        with pytest.raises(ValueError, match="region.checkpoint.safetensors belongs to another run"):
            go("region", data, tmp_path, **other)
    go("region", data, tmp_path / "fresh", seed=1)
    with pytest.raises(ValueError, match="belongs to another run"):  # the start has the same name, but other weights
        go("region", data, tmp_path, start=tmp_path / "fresh" / "weights")


def test_a_branch_does_not_go_on_after_another_autoencoder(trained, data, tmp_path):
    go("autoencoder", data, tmp_path)
    go("optical", data, tmp_path)
    shutil.rmtree(tmp_path / "weights")
    go("autoencoder", data, tmp_path / "other", seed=1)
    (tmp_path / "other" / "weights").rename(tmp_path / "weights")
    with pytest.raises(ValueError, match="optical.checkpoint.safetensors belongs to another run"):
        go("optical", data, tmp_path)


def test_folders_of_one_name_are_validated_apart(data, tmp_path, monkeypatch):
    folders = [shutil.copytree(data, tmp_path / place / "val") for place in ("a", "b")]
    seen = {}
    monkeypatch.setattr(module, "train_on", lambda part, config, pool, held_out, *how, **more: seen.update(held_out))
    train("region", TINY, [data], [*folders, data], tmp_path / "out", tmp_path)
    assert list(seen) == ["a/val", "b/val", data.name]


def test_folders_are_told_apart_by_the_fewest_parts(tmp_path):
    a, b, c = tmp_path / "a" / "x" / "val", tmp_path / "b" / "x" / "val", tmp_path / "c" / "other"
    assert told_apart([a, b, c]) == {"a/x/val": a, "b/x/val": b, "other": c}
    assert told_apart([a, str(a), c]) == {"val": str(a), "other": c}
    assert told_apart(["val", "x/val"]) == {f"{Path.cwd().name}/val": "val", "x/val": "x/val"}


def test_groups_of_like_names_are_added_up():
    groups = [make_scenes(3, (32, 32)), make_scenes(2, (32, 32)), make_scenes(3, (32, 32), 1)]
    assert count_scenes(groups) == {"made_0 to made_2": 6, "made_0 to made_1": 2}


def test_the_card_counts_scenes_of_like_names(data, tmp_path):
    notes = train("region", TINY, [data, data], [data], tmp_path / "weights", tmp_path, Recipe(steps=1, batch=2, lr=0))
    assert notes["scenes"] == {"val_00000 to val_00002": 6}


def test_settings_name_a_folder():
    assert folder_name({"unet.width": 48, "size": "96, 128"}) == "unet.width=48,size=96,128"
    assert folder_name({"schedule.name": "a/b"}) == "schedule.name=a-b"


def test_one_folder_holds_one_system(trained, data):
    home = trained[0]
    changes = [{"size": "32,64"}, {"window": 96}, {"evidence": False}, {"refine.looks": "1.5"}]
    changes.append({"sampler.prediction": "v", "unet.anchor": False})
    for change in [*changes, {"detail.width": 16}]:
        before = (home / "weights" / "card.json").read_bytes()
        with pytest.raises(
            ValueError, match=f"weights holds weights of another .*{next(iter(change)).split('.')[0]}.* setting"
        ):
            go("region", data, home, override(TINY, **change))
        assert (home / "weights" / "card.json").read_bytes() == before
    scenes = [load_scenes(data)]
    with pytest.raises(ValueError, match="another size setting"):
        train_on("region", override(TINY, size="32,64"), scenes, None, home / "weights", home, RECIPE)
    check_same_system(override(TINY, **{"sampler.samples": 9, "refine.median": 3}), home / "weights")  # not in weights


def test_the_card_has_the_command_that_it_is_given(trained, data, tmp_path):
    assert read_card(trained[0] / "weights")["parts"]["region"]["command"] is None
    go("region", data, tmp_path, command="python -m ditr_lite train")
    assert read_card(tmp_path / "weights")["parts"]["region"]["command"] == "python -m ditr_lite train"


def test_what_cannot_be_trained_is_refused(trained, data, tmp_path):
    home, _ = trained
    with pytest.raises(ValueError, match="unknown part 'unet'; choose one of autoencoder"):
        go("unet", data, tmp_path)
    with pytest.raises(ValueError, match="no scenes in"):
        go("region", tmp_path / "nothing", tmp_path)
    with pytest.raises(ValueError, match="no weights"):  # a branch needs the autoencoder first
        go("optical", data, tmp_path)
    with pytest.raises(ValueError, match="holds weights of another unet setting"):
        go("optical", data, home, override(TINY, **{"unet.width": 16}))


def test_parts_need_those_that_they_build_on():
    lite = preset("lite")
    assert needs("detail", TINY) == ["autoencoder", "optical", "geometric"] and needs("region", TINY) == []
    assert needs("region", lite) == ["encoder"] and needs("optical", lite) == ["autoencoder", "encoder"]
    assert needs("autoencoder", lite) == []


def test_what_a_part_builds_on_is_borrowed_where_the_shipped_one_fits(tmp_path):
    with pytest.warns(UserWarning, match="has no autoencoder: the shipped one is copied there"):
        borrow("optical", preset("lite"), tmp_path / "a")
    assert set(read_card(tmp_path / "a")["parts"]) == {"autoencoder", "encoder"}
    borrow("optical", preset("lite"), tmp_path / "a")  # a second time nothing is missing
    borrow("optical", TINY, tmp_path / "b")
    borrow("optical", override(preset("lite"), **{"unet.width": 16}), tmp_path / "c")
    assert not (tmp_path / "b").exists() and set(read_card(tmp_path / "c")["parts"]) == {"encoder"}


def test_stage_one_is_validated_at_its_first_look(data):
    scenes, sizes = load_scenes(data), set()

    class Claiming(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.bias = torch.nn.Parameter(torch.zeros(1))

        def forward(self, rgb, depth_n, valid):
            sizes.add(tuple(rgb.shape[2:]))
            glass = torch.linspace(-9, 9, rgb.shape[3]).expand(rgb[:, 0].shape)  # claimed in the right half
            return {"logits": torch.stack([-glass, glass, torch.full_like(glass, -99)], dim=1)}

    pairs = list(claims_in_order(Claiming(), override(TINY, **{"refine.looks": (1.5,)}), scenes))
    assert sizes == {(96, 144)} and len(pairs) == len(scenes)
    [batch] = frames_in_order(scenes, (96, 144))
    for (claimed, true), picture in zip(pairs, (batch.material != IGNORE).numpy(), strict=True):
        assert not picture.all()  # in the padding nothing is claimed, as in the system
        assert (claimed[:, 72:] == picture[:, 72:]).all() and not claimed[:, :72].any()
        assert true.shape == (96, 144) and true.any()


@pytest.mark.parametrize(("branch", "due"), [("optical", 0.01), ("geometric", 0.0)])
def test_errors_of_a_branch_are_those_of_its_own_pixels(branch, due, monkeypatch):
    scenes = load_scenes(SAMPLES / "val", limit=9)  # one more than a batch

    def wrong_inside(branch, painter, batch, config, seed=0):
        region = batch.region
        painted = batch.bounds.normalise(batch.truth_m.clamp(min=0.1) * (0.01 * region).exp())
        return painted, region if branch == "optical" else (1 - region) * (1 - batch.valid)

    monkeypatch.setattr(module.recipes, "one_step", wrong_inside)
    found = scene_errors(branch, None, Config(), scenes)
    np.testing.assert_allclose(found, due, atol=1e-5)


def test_stage_one_of_fewer_levels_takes_the_first_stages_of_the_pretrained_encoder(tmp_path):
    config = override(preset("lite"), **{"region.levels": "4"})
    store.copy_part("encoder", WEIGHTS, tmp_path, config)
    found, whole = module.parts_with("region", config, tmp_path, 0)["region"], load_part("encoder", tmp_path)
    here = found.encoder_rgb.encoder.state_dict()
    assert 0 < len(here) < len(whole) and all(torch.equal(value, whole[name]) for name, value in here.items())


def test_a_checkpoint_is_of_the_shares_at_which_scenes_are_drawn(data, tmp_path):
    scenes = [load_scenes(data, limit=1), load_scenes(data, limit=2)]
    how = (None, tmp_path / "weights", tmp_path / "work", RECIPE)
    train_on("region", TINY, Pool(scenes, [1, 0]), *how)
    with pytest.raises(ValueError, match="belongs to another run"):
        train_on("region", TINY, Pool(scenes, [0, 1]), *how)


def test_scenes_without_a_branch_s_pixels_keep_their_place(monkeypatch):
    scenes = load_scenes(SAMPLES / "val", limit=4)
    bare = np.where(scenes.material[1] > 0, 0, scenes.material[1])
    bare[:3] = IGNORE  # as the padding of a frame, which is no glass
    scenes.material[1] = bare
    monkeypatch.setattr(module.recipes, "one_step", lambda branch, painter, batch, *_: (batch.gt_n, batch.region))
    found = scene_errors("optical", None, Config(), scenes)
    assert np.isnan(found).tolist() == [False, True, False, False]
    assert np.isnan(scene_errors("optical", None, Config(), every(scenes, [1]))).tolist() == [True]


def test_root_mean_squares_are_per_view_and_of_the_chosen_pixels():
    error = torch.tensor([[3.0, 4.0, 99.0], [1.0, 1.0, 1.0]]).view(2, 1, 1, 3)
    where = torch.tensor([[1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]).view(2, 1, 1, 3)
    first, second = root_mean_square(error, where)
    assert first == pytest.approx(12.5**0.5) and np.isnan(second)


def test_false_claims_are_the_share_of_all_pixels_claimed_where_nothing_is(monkeypatch):
    left, all_of_it = np.zeros((4, 8), bool), np.ones((4, 8), bool)
    left[:, :4] = True
    monkeypatch.setattr(module, "claims_in_order", lambda *_: iter([(all_of_it, left), (left, ~all_of_it)]))
    assert module.validate_region(None, TINY, None) == {"iou": 0.5, "false": 0.5}
    monkeypatch.setattr(module, "claims_in_order", lambda *_: iter([(left, left)]))
    assert module.validate_region(None, TINY, None) == {"iou": 1.0, "false": 0.0}


@pytest.mark.parametrize(("wrong", "due"), [("read", 0.0), ("holes", 0.1)])
def test_the_autoencoder_of_the_geometric_branch_is_judged_in_holes(wrong, due, monkeypatch):
    scenes = make_scenes(2, TINY.size)
    scenes.depth[:, -9:, -9:] = 0  # a hole outside the region
    [batch] = frames_in_order(scenes, TINY.size)
    outside = (1 - batch.region) * (batch.valid if wrong == "read" else 1 - batch.valid)
    off = batch.bounds.normalise(batch.truth_m.clamp(min=0.1) * (0.1 * outside).exp())
    model = Mock(return_value={"reconstruction": off})
    model.quantizer.usage = 1.0
    monkeypatch.setattr(module, "device_of", lambda model: "cpu")
    monkeypatch.setattr(module, "held_out_batches", lambda *_: [batch])
    found = module.validate_autoencoder(model, TINY, scenes)
    assert found["geometric"] == pytest.approx(due, abs=1e-5) and found["optical"] == pytest.approx(0, abs=1e-5)


def test_an_error_of_two_branches_is_the_mean_of_those_that_are_asked(monkeypatch):
    scenes = make_scenes(3, TINY.size)
    [batch] = frames_in_order(scenes, TINY.size)
    asked = {"optical": torch.tensor([1.0, 1, 0]), "geometric": torch.tensor([1.0, 0, 0])}
    error = {"optical": 0.1, "geometric": 0.3}

    def one_step(branch, painter, batch, config):
        painted = batch.bounds.normalise(batch.truth_m.clamp(min=0.1) * np.exp(error[branch]))
        return painted, asked[branch].view(3, 1, 1, 1) * batch.gt_known

    monkeypatch.setattr(module, "device_of", lambda model: "cpu")
    monkeypatch.setattr(module, "held_out_batches", lambda *_: [batch])
    monkeypatch.setattr(module.recipes, "one_step", one_step)
    monkeypatch.setattr(module.recipes, "sharpened", lambda model, decoded, *_: decoded)
    found = module.sharpened_errors(None, dict.fromkeys(asked), override(TINY, window=0), scenes)
    np.testing.assert_allclose(found, [0.2, 0.1, np.nan], atol=1e-5)
