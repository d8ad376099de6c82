"""``train`` on a dataset and with its cost, fine-tuning, and ``compare``."""

import json
import os
import re
import shutil
import subprocess
import sys
from argparse import Namespace
from dataclasses import replace

import pytest

from ditr_lite import data, store
from ditr_lite.cli import main
from ditr_lite.cli.train import count_frames, judgement

TINY = ["--preset", "tiny", "--steps", "1", "--batch", "2"]
SMALL = ["size=64,96", "autoencoder.width=8", "autoencoder.codes=64", "unet.width=8", "unet.cond_channels=8"]
SMALL_PAPER = ["--preset", "paper", *(word for setting in SMALL for word in ("--set", setting))]


def refused(argv, capsys):
    assert main(argv) == 2
    return capsys.readouterr().err.strip().removeprefix("ditr_lite: error: ")


@pytest.fixture(scope="module")
def exported(scenes, tmp_path_factory):
    """The small scenes in ClearGrasp's layout."""
    root = tmp_path_factory.mktemp("exported") / "cleargrasp"
    from ditr_lite.camera import Camera
    from ditr_lite.datasets.export import export

    samples = [data.read_sample(path) for path in sorted((scenes / "val").iterdir())]
    camera = Camera(90, 90, 47.5, 31.5, 96, 64)
    return export("cleargrasp", root, [replace(s, camera=camera) for s in samples])


def test_a_dataset_is_trained_on_alone_and_mixed(exported, scenes, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    dataset = ["--dataset", "cleargrasp", "--root", str(exported), "--val", str(scenes / "test")]
    for name, more in (("alone", []), ("mixed", ["--data", str(scenes / "val"), "--scene-share", "0.25"])):
        argv = ["train", "--part", "region", *TINY, *dataset, *more, "--out", name, "--work", f"{name}-work"]
        assert main([*argv, "--workers", "1", "--accumulate", "2"]) == 0
        entry = store.read_card(name)["parts"]["region"]
        assert entry["dataset"] == "cleargrasp" and entry["scene_share"] == (0.25 if more else 0.0)
        assert len(entry["scenes"]) == (2 if more else 1)


@pytest.mark.skipif(sys.platform == "win32", reason="torch's build for Windows has no libuv store")
@pytest.mark.parametrize("how", [TINY, [*SMALL_PAPER, "--steps", "1", "--batch", "2"]], ids=["tiny", "paper"])
def test_two_processes_train_together(how, scenes, tmp_path):
    command = [*"-m torch.distributed.run --standalone --nproc-per-node=2".split(), *"-m ditr_lite train".split()]
    command += [*how, "--part", "region", "--data", scenes / "val", "--val", scenes / "test"]
    command += ["--out", tmp_path / "out", "--work", tmp_path / "work"]
    surroundings = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, *command], env=surroundings, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.count("region.safetensors: 1 steps") == 1  # apart, both would say it, and write the same files
    assert store.read_card(tmp_path / "out")["parts"]["region"]["shares"] == 2
    if how is not TINY:
        assert done.stdout.count("1 views at a time") == 1  # the cost, of a process


def test_the_papers_preset_says_what_it_costs_before_it_starts(scenes, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    argv = ["train", "--preset", "paper", "--data", str(scenes / "val"), "--val", str(scenes / "test"), "--cost"]
    assert main(argv) == 0
    printed = capsys.readouterr().out
    assert [line.split()[0] for line in printed.splitlines() if " of the paper preset" in line] == [
        *("autoencoder", "region", "optical", "geometric")
    ]
    assert "region of the paper preset, 200 steps of 16 views of 1280 x 736" in printed  # 3 scenes: a step an epoch
    assert "optical of the paper preset, 200 steps of 64 views" in printed
    assert len(re.findall(r"hours +[\d,.]+ \(here", printed)) == 4 and "RTX 3090" in printed
    assert not (tmp_path / "outputs").exists()


def test_a_step_of_the_papers_recipe_runs_at_a_reduced_size(scenes, tmp_path, capsys):
    argv = ["train", *SMALL_PAPER, "--data", str(scenes / "val"), "--val", str(scenes / "test"), "--steps", "1"]
    argv += ["--batch", "2", "--out", str(tmp_path / "out"), "--work", str(tmp_path / "work")]
    assert main(argv) == 0
    parts = store.read_card(tmp_path / "out")["parts"]
    assert list(parts) == ["autoencoder", "region", "optical", "geometric"]  # the paper has no finer final step
    sgd = parts["region"]["recipe"]
    assert (sgd["optimiser"], sgd["momentum"], sgd["weight_decay"], sgd["law"]) == ("sgd", 0.9, 1e-4, "falling")
    assert parts["optical"]["recipe"]["lr"] == 1e-6 and "GFLOP a view" in capsys.readouterr().out


def test_fine_tuning_says_what_it_did_and_needs_a_place_of_its_own(weights, scenes, tmp_path, capsys):
    argv = ["train", "--part", "region", "--start", str(weights), "--data", str(scenes / "val"), "--steps", "2"]
    argv += ["--batch", "2", "--val", str(scenes / "test"), "--work", str(tmp_path / "work")]
    before = (weights / "region.safetensors").read_bytes()
    assert "--start needs --out" in refused(argv, capsys)
    assert "leave out --preset" in refused([*argv, "--preset", "lite", "--out", str(tmp_path / "out")], capsys)
    assert "which fine-tuning never replaces" in refused([*argv, "--out", str(weights)], capsys)
    assert main([*argv, "--out", str(tmp_path / "out"), "--scene-share", "0"]) == 0
    printed = capsys.readouterr().out
    judged = r"1 - IoU of 2 held-out frames \d\.\d+ before, \d\.\d+ after, difference [+-]\d"
    told = r"; the fine-tuned weights of step \d are kept|; the weights of the start are kept"
    judged += rf".*fine-tuning (helped|harmed|made no measurable difference)({told})"
    unjudged = r"no step lowered the error .* \(\d\.\d+ at the start, \d\.\d+ at best later\): the weights of the start"
    assert re.search(f"region: ({judged}|{unjudged})", printed)
    assert ("2 frames are too few for an interval" in printed) == bool(re.search(judged, printed))  # where one is told
    both = [str(scenes / "val") if word == str(scenes / "test") else word for word in argv]
    assert "frames that are trained on cannot judge" in refused([*both, "--out", str(tmp_path / "y")], capsys)
    assert (weights / "region.safetensors").read_bytes() == before
    assert set(store.read_card(tmp_path / "out")["parts"]) == set(store.read_card(weights)["parts"])
    assert "needs frames to learn from" in refused([*argv[:5], "--out", str(tmp_path / "x")], capsys)


def test_a_part_that_is_not_fine_tuned_is_refused_before_frames_are_read(
    weights, scenes, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("ditr_lite.cli.train.own_frames", None)
    argv = ["train", "--part", "autoencoder", "--start", str(weights), "--data", str(scenes / "val")]
    reason = refused([*argv, "--out", str(tmp_path / "out"), "--work", str(tmp_path / "work")], capsys)
    assert "cannot fine-tune 'autoencoder': choose all or one of region, optical, geometric" in reason


def test_weights_of_another_command_are_not_replaced_unasked(scenes, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    argv = ["train", "--part", "region", *TINY, "--data", str(scenes / "val"), "--val", str(scenes / "test")]
    assert main(argv) == 0 and main(argv) == 0  # the very same: nothing is left to do
    assert "by another command" in (reason := refused([*argv, "--seed", "1"], capsys)) and "give --out" in reason


def test_fine_tuning_is_judged_only_where_a_step_was_chosen():
    judged = {"before": [0.2] * 6, "after": [0.1] * 6, "kept": "fine-tuned"}
    notes = {"judged": judged, "best_step": 20, "curve": [{"held_out": 0.2}, {"held_out": 0.1}]}
    said = judgement("optical", notes)
    assert said.startswith(
        "optical: relative RMSE of 6 held-out frames 0.2000 before, 0.1000 after, difference -0.1000"
    )
    assert said.endswith("fine-tuning helped; the fine-tuned weights of step 20 are kept")
    notes = {
        "judged": judged | {"after": judged["before"]},
        "best_step": 0,
        "curve": [{"held_out": 0.2}, {"held_out": 0.3}],
    }
    assert "no step lowered" in (said := judgement("optical", notes)) and "0.2000 at the start, 0.3000" in said


def test_checkpoints_come_as_often_as_they_are_asked_for(weights, scenes, tmp_path, capsys):
    argv = ["train", "--part", "region", "--data", str(scenes / "val"), "--val", str(scenes / "test")]
    argv += ["--steps", "5", "--batch", "2", "--every", "2"]
    for name, how in (("first", ["--preset", "tiny"]), ("tuned", ["--start", str(weights)])):
        assert main([*argv, *how, "--out", str(tmp_path / name), "--work", str(tmp_path / f"{name}-work")]) == 0
        curve = store.read_card(tmp_path / name)["parts"]["region"]["curve"]
        assert [row["step"] for row in curve if row["step"]] == [2, 4, 5]
    argv[2] = "all"
    assert "--every is of a training" in refused([*argv, "--preset", "tiny", "--set", "unet.heads=1"], capsys)


@pytest.mark.parametrize(
    "more",
    [
        ["--cost"],
        ["--precision", "bf16"],
        ["--scene-share", "0.5"],
        ["--zero-region"],
        ["--val-root", "elsewhere"],
        ["--depth-scale", "0.5"],
    ],
)
def test_what_a_comparison_of_settings_does_not_do_is_refused(more, capsys):
    reason = refused(["train", *TINY, "--set", "unet.heads=1", *more], capsys)
    assert reason.startswith(f"a comparison of settings takes no {more[0]}; ")


def test_what_no_writer_has_finished_is_no_scene(scenes, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    left = tmp_path / "val"
    shutil.copytree(scenes / "val" / "val_00000", left / ".val_00000.0123.old.part")
    assert count_frames(Namespace(limit=None), [left], None) == 0
    assert "no scenes in" in refused(["train", *TINY, "--part", "region", "--data", str(left)], capsys)
    comparison = ["train", *TINY, "--set", "unet.heads=1", "--limit", "1", "--val", str(left)]
    assert f"no scenes in {left} to score on" in refused(comparison, capsys)


def test_of_several_processes_the_first_alone_tells_what_was_found(scenes, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("ditr_lite.training.loop.is_first", lambda: False)
    monkeypatch.setattr("ditr_lite.training.boundary.train_boundary", lambda *_, **__: None)
    monkeypatch.setattr("ditr_lite.studies.experiment.compare_over_seeds", lambda *_, **__: None)
    boundary = ["train-boundary", "--data", str(scenes / "val"), "--val", str(scenes / "test")]
    results = tmp_path / "results.json"
    comparison = ["train", *TINY, "--set", "unet.heads=1", "--json", str(results)]
    for argv in (boundary, comparison):
        assert main(argv) == 0
    assert capsys.readouterr().out == "" and not results.exists()


def test_the_cost_of_fine_tuning_is_shown_and_nothing_trained(weights, scenes, tmp_path, capsys):
    argv = ["train", "--start", str(weights), "--data", str(scenes / "val"), "--out", str(tmp_path / "out")]
    assert main([*argv, "--work", str(tmp_path / "work"), "--cost"]) == 0
    printed = capsys.readouterr().out
    assert printed.count(" of the tiny preset, 300 steps of 8 views") == 3 and "detail of the tiny" in printed
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        (["--every", "0"], "--every: expected at least 1"),
        (["--root", "x"], "--root is of --dataset NAME"),
        (["--dataset", "todd"], "--dataset todd needs --root DIR"),
        (["--accumulate", "0"], "--accumulate: expected at least 1"),
        (["--precision", "fp8"], "unknown precision 'fp8'"),
        (["--scene-share", "1"], "expected a share from 0 to below 1, got 1"),
        (["--scene-share", "0.5"], "--scene-share is of --dataset NAME"),
        (["--zero-region"], "--zero-region is of --dataset NAME"),
    ],
)
def test_bad_command_lines_are_named(scenes, tmp_path, more, reason, capsys):
    argv = ["train", "--part", "region", *TINY, "--data", str(scenes / "val"), "--out", str(tmp_path / "out")]
    assert reason in refused([*argv, *more], capsys)


def test_two_weights_folders_are_compared_on_the_same_frames(weights, scenes, tmp_path, capsys):
    results = tmp_path / "compared.json"
    argv = ["compare", str(weights), str(weights), "--root", str(scenes), "--limit", "2", "--json", str(results)]
    assert main([*argv, "--given-region"]) == 0
    printed = capsys.readouterr().out
    assert "B - A" in printed and "+0.0 [+0.0, +0.0]" in printed and "1.000 [1.000, 1.000]" in printed
    found = json.loads(results.read_text())
    assert found["rmse_m"]["first"] == found["rmse_m"]["second"] and len(found["frames"]) == 2
    assert found["weights_sha256"] == found["second_sha256"]
    assert "no weights in" in refused(["compare", str(weights), str(tmp_path / "none")], capsys)


def test_one_system_is_compared_with_itself_working_otherwise(weights, scenes, capsys):
    argv = ["compare", str(weights), "--root", str(scenes), "--limit", "2", "--given-region"]
    assert main([*argv, "--set", "sampler.steps=2"]) == 0
    printed = capsys.readouterr().out
    assert f"B = {weights} sampler.steps=2" in printed and "optical" in printed
    assert "B is missing" in refused(argv, capsys)
    assert "unet.width shapes the weights" in refused([*argv, "--set", "unet.width=4"], capsys)
    assert "unknown setting 'refine.wide'" in refused([*argv, "--set", "refine.wide=4"], capsys)


def test_two_results_files_are_held_against_each_other(weights, tmp_path, capsys):
    frames = {f"test_{k:05d}": {"ditr": {"optical": 0.03 + 0.001 * k}, "raw": {"optical": 0.05}} for k in range(8)}
    for name, rows in (("a", frames), ("b", dict(list(frames.items())[1:]))):
        report = {"command": f"make {name}", "source": "test split", "rmse_m": rows}
        (tmp_path / f"{name}.json").write_text(json.dumps(report))
    both = ["compare", str(tmp_path / "a.json"), str(tmp_path / "b.json")]
    assert main([*both, "--json", str(tmp_path / "c.json")]) == 0
    printed = capsys.readouterr().out
    assert "A was made by make a, B by make b" in printed and "+0.0 [+0.0, +0.0]" in printed
    assert "1 frames that only one of both has are left out" in printed
    assert len(json.loads((tmp_path / "c.json").read_text())["frames"]) == 7
    assert main([*both, "--method", "raw", "--method", "ditr"]) == 0
    assert "-16.0 [" in capsys.readouterr().out  # 34 mm, the mean of 31 to 37, instead of 50
    for more, reason in (
        (["--method", "mine"], "has no method 'mine'; it has ditr, raw"),
        (["--limit", "2"], "take no --limit"),
        (["--set", "sampler.steps=2"], "take no --set"),
    ):
        assert reason in refused([*both, *more], capsys)
    assert "of two kinds" in refused([*both[:2], str(weights)], capsys)
    (tmp_path / "b.json").write_text(json.dumps({"command": "x", "source": "rooms split", "rmse_m": frames}))
    assert "of other frames: test split and rooms split" in refused(both, capsys)
    (tmp_path / "b.json").write_text(json.dumps({"command": "x"}))
    assert "the second file holds no RMSE by frame" in refused(both, capsys)


@pytest.mark.parametrize(
    ("after", "word"),
    [((0.1, 0.2, 0.3), "helped"), ((0.5, 0.7, 0.9), "harmed"), ((0.3, 0.4, 0.5), "no measurable difference")],
)
def test_a_lower_error_after_fine_tuning_is_called_a_help(after, word):
    judged = {"before": [0.3, 0.4, 0.5], "after": list(after), "kept": "tuned"}
    assert word in judgement("optical", {"judged": judged, "best_step": 3})


def test_unit_and_place_of_a_dataset_need_a_dataset(weights, scenes, capsys):
    argv = ["train", "--data", str(scenes / "val"), "--val", str(scenes / "test"), "--part", "region", "--steps", "1"]
    assert "--depth-scale is of --dataset NAME" in refused([*argv, "--depth-scale", "0.1"], capsys)
    assert "--val-root is of --dataset NAME" in refused([*argv, "--val-root", "x"], capsys)
    both = ["compare", str(weights), str(weights)]
    assert "--depth-scale is of --dataset folder" in refused([*both, "--depth-scale", "0.1"], capsys)
