import ast
import importlib.util
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import ditr_lite
from ditr_lite.config import override, preset
from ditr_lite.data import SAMPLES
from ditr_lite.store import load_part, read_card
from ditr_lite.studies import experiment
from ditr_lite.studies.experiment import QUICK, TOUCHES, compare_settings, format_comparison, touched
from ditr_lite.training.parts import PARTS

TINY = preset("tiny")
SHORT = {"steps": 1, "limit": 2, "frames": 2}


def run(folder, settings, **others):
    return compare_settings(settings, folder=folder, **{**SHORT, **others})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("weights")


@pytest.fixture(scope="module")
def result(folder):
    return run(folder, {"unet.heads": 1})


# --- what has to be trained again -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "parts"),
    [
        ({"size": "32,64"}, PARTS),
        ({"window": "32"}, ("autoencoder", "optical", "geometric", "detail")),
        ({"autoencoder.codes": 32}, ("autoencoder", "optical", "geometric", "detail")),
        ({"unet.width": "16"}, ("optical", "geometric", "detail")),
        ({"schedule.name": "cosine"}, ("optical", "geometric", "detail")),
        ({"sampler.prediction": "v", "unet.anchor": "false"}, ("optical", "geometric", "detail")),
        ({"evidence": "false"}, ("optical", "detail")),
        ({"detail.width": 16}, ("detail",)),
        ({"detail.width": 0}, ()),
        ({"unet.width": 16, "detail.width": 0}, ("optical", "geometric")),
        ({"region.width": 16}, ("region",)),
        ({"sampler.samples": 1}, ()),
        ({"refine.looks": "1.5"}, ("region",)),
        ({"refine.median": 3, "evidence": "false"}, ("optical", "detail")),
    ],
)
def test_only_what_a_setting_touches_is_trained_again(settings, parts):
    assert touched(TINY, settings) == parts


def test_every_setting_of_the_system_has_its_entry():
    for name in vars(TINY):
        assert name == "name" or any(key.split(".")[0] == name for key in TOUCHES), name
    for name in vars(TINY.sampler):
        assert f"sampler.{name}" in TOUCHES
    assert set(QUICK) == set(PARTS)


@pytest.mark.parametrize("settings", [{}, {"unet.heads": 2}, {"unet.heads": "2"}, {"name": "other"}])
def test_settings_that_change_nothing_are_refused(settings):
    with pytest.raises(ValueError, match="nothing is changed"):
        touched(TINY, settings)


def used_by(module, seen):
    """Collect the files of the package that a module imports, and those that they import, in ``seen``."""
    file = Path(importlib.util.find_spec(module).origin)
    if file in seen:
        return
    seen.add(file)
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            package = module if file.name == "__init__.py" else module.rpartition(".")[0]
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            for name in [base, *(f"{base}.{alias.name}" for alias in node.names)]:
                if name != "ditr_lite" and is_module(name):
                    used_by(name, seen)


def is_module(name):
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # what is before the last dot is no package
        return False


def test_all_that_decides_training_counts_and_nothing_else_does():
    package = Path(ditr_lite.__file__).parent
    seen = set()
    used_by("ditr_lite.training.parts", seen)
    used = {file.relative_to(package).as_posix() for file in seen}
    no_matter = {"metrics.py", "files.py", "store.py", "camera.py", "training/__init__.py", "loss_types.py"}
    decisive = {file.relative_to(package).as_posix() for file in experiment.decisive_files()}
    idle = {name for name in decisive - used if not name.startswith("boundary/")}  # backends are imported by name
    no_matter |= {"training/checkpoints.py", "training/readers.py", "training/kept_maps.py"}  # arms read no dataset
    used = {name for name in used if not name.startswith("datasets/")}
    assert used - decisive <= no_matter and not idle
    assert all(file.is_file() for file in experiment.decisive_files())


# --- the comparison ---------------------------------------------------------------------------------------------------


def test_both_arms_are_scored_on_the_same_frames(result):
    assert (result["frames"], result["scenes"], result["region"]) == (2, 2, "given")
    assert result["trained"] == ["optical", "geometric", "detail"]
    for key in ("optical", "geometric"):
        default, changed = (result["rmse_m"][arm][key] for arm in ("default", "changed"))
        assert len(default) == len(changed) == 2 and all(0 < v < 5 for v in default + changed)
        mean, low, high = result["difference"][key]
        assert mean == pytest.approx(np.mean(changed) - np.mean(default)) and low <= mean <= high
    json.dumps(result)


def test_what_is_not_touched_is_the_very_same(result, folder):
    default, changed = folder / "tiny" / "default", folder / "tiny" / "unet.heads=1"
    for part in ("region", "autoencoder"):
        ours, theirs = load_part(part, default), load_part(part, changed)
        assert all(torch.equal(ours[k], theirs[k]) for k in ours)
        assert read_card(changed)["parts"][part]["copied"] == str(default)
    assert read_card(changed)["config"]["unet"]["heads"] == 1 and read_card(default)["config"]["unet"]["heads"] == 2


def test_an_arm_is_kept_while_all_that_it_depends_on_is_equal(result, folder):
    again = run(folder, {"unet.heads": 1})
    assert again["seconds"] == {"default": 0, "changed": 0} and again["rmse_m"] == result["rmse_m"]
    assert result["seconds"]["default"] > 0
    other = run(folder, {"sampler.samples": 1})
    assert other["seconds"]["default"] == 0 and other["trained"] == []
    assert other["rmse_m"]["default"] == result["rmse_m"]["default"]


@pytest.mark.parametrize("change", [{"seed": 1}, {"limit": 3}, {"steps": 2}])
def test_an_arm_is_trained_anew_when_anything_differs(folder, result, change, tmp_path, monkeypatch):
    calls = []

    def stop(part, config, scenes, *others, **remarks):
        calls.append(part)
        raise KeyboardInterrupt

    monkeypatch.setattr(experiment, "train_on", stop)
    shutil.copytree(folder / "tiny" / "default", tmp_path / "tiny" / "default")  # the others go on using theirs
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, {"unet.heads": 1}, **change)
    assert calls == ["autoencoder"]


def test_damaged_weights_are_not_taken_for_kept_ones(folder, result):
    card = read_card(folder / "tiny" / "default")
    key, parts = card["parts"]["region"]["key"], list(PARTS)
    assert experiment._kept(folder / "tiny" / "default", parts, key)
    assert not experiment._kept(folder / "tiny" / "default", parts, key[::-1])
    assert not experiment._kept(folder / "tiny" / "nothing", parts, key)


def test_settings_of_stage_one_are_scored_with_the_region_that_it_finds(folder, result):
    found = run(folder, {"refine.iterations": 0})
    assert (found["region"], found["trained"]) == ("found", [])
    assert "region found" in format_comparison(found)


def test_scenes_of_ones_own_join_the_shipped_ones(tmp_path):
    more = run(tmp_path, {"sampler.samples": 1}, data=SAMPLES / "val", limit=25)
    assert more["scenes"] == 25
    scenes = read_card(tmp_path / "tiny" / "default")["parts"]["region"]["scenes"]
    assert list(scenes.values()) == [24, 1] and list(scenes)[1] == "val_00000 to val_00000"
    few = experiment.some_scenes([SAMPLES / "train", SAMPLES / "val"], 3)
    assert [len(group) for group in few] == [3]


def test_the_report_names_both_arms_and_its_limits(result):
    text = format_comparison(result)
    assert "tiny as it is" in text and "unet.heads=1" in text and "another seed" in text
    assert f"{1000 * np.mean(result['rmse_m']['default']['optical']):.1f}" in text
    assert len({len(line) for line in text.splitlines()[2:6]}) == 1


def test_another_system_is_never_overwritten(tmp_path, folder, result):
    shutil.copytree(folder / "tiny" / "unet.heads=1", tmp_path / "mine")
    before = (tmp_path / "mine" / "card.json").read_bytes()
    for settings in ({"evidence": "false"}, {"unet.heads": 1, "size": "32,64"}, {"unet.width": 16}):
        with pytest.raises(ValueError, match="mine holds weights of another"):
            run(tmp_path, settings, out=tmp_path / "mine")
    with pytest.raises(ValueError, match="default holds weights of another unet"):  # where the other arm goes
        run(folder, {"unet.heads": 1}, out=folder / "tiny" / "default")
    assert (tmp_path / "mine" / "card.json").read_bytes() == before and not (tmp_path / "tiny").exists()
    again = run(folder, {"unet.heads": 1}, out=tmp_path / "mine", command="the command", seed=1)
    card = read_card(tmp_path / "mine")["parts"]
    assert (
        again["seconds"]["changed"] > 0 and card["optical"]["command"] == "the command" and card["optical"]["seed"] == 1
    )


@pytest.mark.parametrize("settings", [{"unet.heads": 3}, {"unet.query": "foo"}, {"region.levels": 1}])
def test_what_cannot_be_built_is_refused_before_anything_is_trained(tmp_path, settings):
    with pytest.raises(ValueError):
        run(tmp_path, settings)
    assert not (tmp_path / "tiny").exists()


class Narrow(torch.nn.Module):
    def __init__(self, in_channels, channels, time_channels):
        super().__init__()
        self.conv = torch.nn.Conv2d(in_channels, channels, 3)  # no padding: two pixels are lost

    def forward(self, x, time):
        return self.conv(x)


class Foreign(torch.nn.Module):
    def __init__(self, channels):
        super().__init__()


@pytest.mark.parametrize(("block", "got"), [(Narrow, r"got \(2, 5, 4, 2\)"), (Foreign, "positional argument")])
def test_a_block_of_another_kind_is_told_what_a_block_is(tmp_path, monkeypatch, block, got):
    monkeypatch.setitem(experiment.BLOCKS, "mine", block)
    with pytest.raises(ValueError, match=rf"unet.BLOCKS\['mine'\]: expected block\(in_channels.*{got}"):
        run(tmp_path, {"unet.block": "mine"})
    assert not (tmp_path / "tiny").exists()


def test_nothing_to_score_on_is_said_before_anything_is_trained(tmp_path):
    with pytest.raises(ValueError, match="no scenes in"):
        compare_settings({"unet.heads": 1}, val=tmp_path, folder=tmp_path / "weights")
    assert not (tmp_path / "weights").exists()


def run_of(seed, default, changed):
    arms = {"default": {"optical": default, "geometric": [None] * 3}}
    arms["changed"] = {"optical": changed, "geometric": [None] * 3}
    told = {"settings": {"unet.heads": "1"}, "trained": ["optical"], "scenes": 2, "frames": 3, "region": "given"}
    return {**told, "seed": seed, "rmse_m": arms}


def test_seeds_by_hand(monkeypatch):
    runs = {5: run_of(5, [0.1, 0.2, None], [0.2, 0.3, None]), 6: run_of(6, [0.1, 0.2, None], [0.3, 0.4, None])}
    homes = []

    def fake(settings, seed, folder, work):
        homes.append((folder, work))
        return runs[seed]

    monkeypatch.setattr(experiment, "compare_settings", fake)
    found = experiment.compare_over_seeds({"unet.heads": 1}, (5, 6), folder="w")
    assert homes == [("w", None), (Path("w/seed_6"), None)]  # no arm replaces that of another seed
    optical = found["difference"]["optical"]
    assert np.allclose(optical.pop("by_seed"), [0.1, 0.2])
    assert optical == pytest.approx(
        {"mean": 0.15, "low": 0.15, "high": 0.15, "spread": 0.005**0.5, "seeds_apart": 0.1, "clear": True}
    )
    assert found["difference"]["geometric"] is None
    text = experiment.format_seeds(found)
    assert "150.0 -> 250.0" in text and "150.0 -> 350.0" in text and "geometric: no frame" in text
    assert "a larger error than tiny as it is (+150.0 mm" in text and "seeds 100.0 mm apart: clear" in text


@pytest.mark.parametrize(("seeds", "out"), [((), None), ((0, 1), "mine")])
def test_seeds_that_cannot_be_are_refused(seeds, out):
    with pytest.raises(ValueError, match="at least one seed"):
        experiment.compare_over_seeds({"unet.heads": 1}, seeds, out=out)


class Mine(torch.nn.Module):
    pass


class Other(torch.nn.Module):
    depth = 2


def test_a_block_of_the_readers_own_is_code_that_decides(monkeypatch):
    config = override(preset("tiny"), **{"unet.block": "mine"})

    def key(block):
        monkeypatch.setitem(experiment.BLOCKS, "mine", block)
        return experiment._key(config, [], {})

    assert key(Mine) == key(Mine) != key(Other)
    typed = type("Typed", (torch.nn.Module,), {"__module__": "nowhere"})  # as in a session whose text is gone
    assert key(typed) != key(typed)
