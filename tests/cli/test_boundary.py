"""The boundary commands and ``tools/guide_study.py``, each on the smallest of runs."""

import json

import guide_study as study
import pytest
import torch

from ditr_lite import pipeline, store
from ditr_lite.boundary import learned
from ditr_lite.cli import main
from ditr_lite.config import override, preset
from ditr_lite.data import SAMPLES, list_samples
from ditr_lite.evaluation import boundary as boundary_scoring
from ditr_lite.evaluation import results
from ditr_lite.training import boundary as boundary_training
from ditr_lite.training.scenes import load_scenes


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """An untrained autoencoder of the tiny preset and untrained boundary networks."""
    folder, config = tmp_path_factory.mktemp("weights"), override(preset("tiny"), **{"unet.heads": 1})
    torch.manual_seed(0)
    parts = pipeline.build(config)
    store.save_part("autoencoder", parts["autoencoder"].state_dict(), config, folder, {})
    state = learned.build_nets().state_dict() | {"thresholds": torch.tensor([0.3, 0.3])}
    store.save_part("boundary", state, config, folder, {})
    return folder


def test_training_writes_the_part_and_says_how_good_it_is(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(boundary_training, "VALIDATE", 1)
    argv = ["train-boundary", "--data", str(SAMPLES / "val"), "--val", str(SAMPLES / "val"), "--limit", "2"]
    argv += ["--steps", "2", "--batch", "1", "--lr", "1e-3", "--out", str(tmp_path / "w"), "--work", str(tmp_path)]
    assert main(argv) == 0
    out = capsys.readouterr().out
    assert "boundary.safetensors: rgb F" in out and "depth F" in out
    assert list(store.read_card(tmp_path / "w")["parts"]) == ["boundary"]


def test_training_without_scenes_is_refused(tmp_path, capsys):
    assert main(["train-boundary", "--data", str(tmp_path), "--out", str(tmp_path / "w")]) == 2
    assert "no scenes in" in capsys.readouterr().err and not (tmp_path / "w").exists()


def test_scores_are_printed_and_written(weights, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(boundary_scoring, "CANNY", {"sigma": (1.0,), "high": (90,), "ratio": (0.3,)})
    target = tmp_path / "b.json"
    argv = ["bench-boundary", "--split", "val", "--limit", "2", "--weights", str(weights), "--json", str(target)]
    assert main(argv) == 0
    out, written = capsys.readouterr().out, json.loads(target.read_text())
    assert all(name in out for name in ("m_rgb", "m_da", "canny", "classical", "learned"))
    assert written["command"].startswith("python -m ditr_lite bench-boundary --split val --limit 2")
    assert list(written["f"]["m_rgb"]["learned"]) == list_samples("val")[:2] and written["tolerance_px"] == 1
    assert written["weights_sha256"] == {"boundary": store.sha256(weights / "boundary.safetensors")}
    assert results.is_current(written, weights)
    assert main([*argv[:-1], str(tmp_path / "b.txt")]) == 2 and main([*argv, "--sam", str(tmp_path)]) == 2


def test_guide_study_gives_every_guide_to_both_branches_and_goes_on_where_it_was(weights, tmp_path):
    target = tmp_path / "g.json"
    argv = ["--data", str(SAMPLES / "val"), "--test", str(SAMPLES / "val"), "--limit", "3", "--test-limit", "2"]
    argv += ["--steps", "2", "--batch", "2", "--width", "8", "--weights", str(weights)]
    argv += ["--work", str(tmp_path / "work"), "--json", str(target)]
    assert study.main(argv) == 0
    first = json.loads(target.read_text())
    assert (
        first["learnt_from"][0]["scenes"] == 3
        and first["steps"] == 2
        and set(first["branches"]) == {"optical", "geometric"}
    )
    for entry in first["branches"].values():
        assert list(entry["rows"]) == list(entry["frames"]) == list(study.READ)
        assert all(len(v) == 2 for v in entry["frames"].values())
        assert all("minus_none_m" in row for kind, row in entry["rows"].items() if kind != "none")
        mean, low, high = entry["rows"]["exact"]["rmse_m"]
        assert 0 < low <= mean <= high
    assert study.main(argv) == 0  # from the checkpoints: nothing is left to train
    assert json.loads(target.read_text())["branches"] == first["branches"]
    other = store.load_part("autoencoder", weights)
    other = {name: tensor + 1 if tensor.is_floating_point() else tensor for name, tensor in other.items()}
    store.copy_weights(weights, tmp_path / "other", store.read_config(weights))
    store.save_part("autoencoder", other, store.read_config(weights), tmp_path / "other", {})
    with pytest.raises(ValueError, match="belongs to another run, of other settings"):
        study.main([*argv, "--weights", str(tmp_path / "other")])


def test_the_guides_of_the_study_differ_only_where_they_should():
    scenes = load_scenes(SAMPLES / "val", limit=1)
    maps = dict(zip(study.TRAINED, study.guides(scenes, only=study.TRAINED)[:, 0], strict=True))
    assert not maps["none"].any() and maps["m_rgb"].any() and maps["exact"].any()
    assert (maps["m_da"] <= maps["m_rgb"]).all()


def test_training_writes_into_no_folder_that_holds_something_else(scenes, frame, capsys):
    argv = ["train-boundary", "--data", str(scenes / "val"), "--val", str(scenes / "val"), "--out", str(frame)]
    assert main(argv) == 2
    assert "holds something else than weights and checkpoints, a.png" in capsys.readouterr().err
