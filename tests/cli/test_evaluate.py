"""``evaluate`` and ``bench``: units, bad frames, results that replace nothing else, a reader's failing method."""

import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from ditr_lite import data, pipeline
from ditr_lite.cli import evaluate, main
from ditr_lite.datasets import export

QUICK = ["--steps", "1", "--samples", "1"]


@pytest.fixture
def folder(scenes, tmp_path):
    """Three frames as a folder of one's own."""
    camera = data.Camera(90.0, 90.0, 47.5, 31.5, 96, 64)
    samples = (replace(data.load_sample(f"test_{k:05d}", scenes), camera=camera) for k in range(3))
    return export.export("folder", tmp_path / "own", samples)


def rescale(folder, factor):
    for kind in ("depth", "truth"):
        for path in (folder / kind).iterdir():
            units = cv2.imread(str(path), -1).astype(np.uint32) * factor
            cv2.imwrite(str(path), units.astype(np.uint16))


def scores(folder, weights, tmp_path, *more):
    target = tmp_path / "e.json"
    argv = ["evaluate", "--dataset", "folder", "--root", str(folder), "--weights", str(weights), *QUICK]
    code = main([*argv, "--given-region", "--json", str(target), *more])
    return code, json.loads(target.read_text())["rmse_m"]


def test_a_folder_in_another_unit_scores_the_same(folder, weights, tmp_path):
    _, plain = scores(folder, weights, tmp_path)
    rescale(folder, 5)  # TUM's fifth of a millimetre
    _, scaled = scores(folder, weights, tmp_path, "--depth-scale", "0.0002")
    assert plain == scaled


def test_bad_frames_are_left_out_and_reported_on_demand(folder, weights, tmp_path, capsys):
    paths = sorted((folder / "depth").iterdir())
    paths[1].write_bytes(paths[1].read_bytes()[:80])
    argv = ["evaluate", "--dataset", "folder", "--root", str(folder), "--weights", str(weights), *QUICK]
    assert main(argv) == 2
    capsys.readouterr()
    code, found = scores(folder, weights, tmp_path, "--skip-bad")
    assert code == 3 and len(found) == 2
    assert f"left out: depth/{paths[1].name}: cannot read" in capsys.readouterr().err
    sorted((folder / "truth").iterdir())[0].unlink()
    code, found = scores(folder, weights, tmp_path, "--skip-bad")
    assert code == 3 and len(found) == 1 and "it has no ground-truth depth" in capsys.readouterr().err


def test_steps_and_samples_reach_the_system_and_the_results_say_how_it_worked(scenes, weights, tmp_path, monkeypatch):
    asked, complete = [], pipeline.Ditr.__call__

    def spy(self, rgb, depth, region=None, steps=None, samples=None):
        asked.append((steps, samples, self.config.refine.threshold))
        return complete(self, rgb, depth, region, steps, samples)

    monkeypatch.setattr(pipeline.Ditr, "__call__", spy)
    target = tmp_path / "e.json"
    argv = ["evaluate", "--root", str(scenes), "--limit", "1", "--weights", str(weights), "--json", str(target)]
    assert main([*argv, "--steps", "2", "--samples", "3", "--threshold", "0.3", "--refine", "3,5,2"]) == 0
    assert asked == [(2, 3, 0.3)]
    written = json.loads(target.read_text())
    told = {key: written[key] for key in ("given_region", "steps", "samples", "threshold", "refine")}
    assert told == {"given_region": False, "steps": 2, "samples": 3, "threshold": 0.3, "refine": [3, 5, 2]}


def test_cleargrasp_is_scored_as_its_own_code_does_unless_another_is_named(scenes, weights, tmp_path, capsys):
    camera = data.Camera(90.0, 90.0, 47.5, 31.5, 96, 64)
    sample = replace(data.load_sample("test_00000", scenes), camera=camera)
    export.export("cleargrasp", tmp_path / "cg", [sample])
    argv = ["evaluate", "--dataset", "cleargrasp", "--root", str(tmp_path / "cg"), "--weights", str(weights), *QUICK]
    for more, whose in (([], "ClearGrasp"), (["--protocol", "lidf"], "LIDF")):
        assert main([*argv, *more]) == 0
        assert re.findall("As (.*)'s code scores", capsys.readouterr().out) == [whose]


def test_why_every_frame_is_bad_is_told(folder, weights, capsys):
    paths = sorted((folder / "depth").iterdir())
    for path in paths:
        path.write_bytes(path.read_bytes()[:80])
    argv = ["evaluate", "--dataset", "folder", "--root", str(folder), "--weights", str(weights), *QUICK]
    assert main([*argv, "--skip-bad"]) == 2
    said = capsys.readouterr().err
    assert all(f"left out: depth/{path.name}: cannot read" in said for path in paths) and "none of the 3 frames" in said


@pytest.mark.parametrize("content", ["{}", "[1]", "my notes", '{"recipe": 3}'])
@pytest.mark.parametrize("command", ["evaluate", "bench", "floor", "bench-boundary"])
def test_results_replace_nothing_else(command, content, tmp_path, capsys):
    path = tmp_path / "mine.json"
    path.write_text(content)
    assert main([command, "--json", str(path)]) == 2
    assert "holds something else than results" in capsys.readouterr().err and path.read_text() == content


def test_a_method_that_is_refused_on_every_frame_ends_the_benchmark(tmp_path, monkeypatch, scenes, weights, capsys):
    (tmp_path / "whole.py").write_text("def fill(rgb, depth, region):\n    return (1000 * depth).astype('uint16')\n")
    monkeypatch.chdir(tmp_path)
    argv = ["bench", "--root", str(scenes), "--limit", "1", "--weights", str(weights), *QUICK, "--no-cost"]
    assert main([*argv, "--method", "whole:fill", "--json", "b.json"]) == 2
    said = capsys.readouterr()
    assert "'fill' was refused on every frame, for the reason above" in said.err and "uint16" in said.out
    assert not (tmp_path / "b.json").exists()


def test_a_failing_method_is_told_by_its_own_line(tmp_path, monkeypatch, scenes, weights, capsys):
    (tmp_path / "indexing.py").write_text("def fill(rgb, depth, region):\n    return depth[0][0][0]\n")
    monkeypatch.chdir(tmp_path)
    argv = ["bench", "--root", str(scenes), "--limit", "1", "--weights", str(weights), *QUICK, "--no-cost"]
    assert main([*argv, "--method", "indexing:fill"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert "your method 'fill' failed: indexing.py, line 2: IndexError" in lines[-1]


def test_a_method_is_compared_with_the_best_baseline_of_each_set():
    def frame(**rmse):
        return {
            "methods": {m: {"optical": {"rmse": v}, "optical_valid": None, "geometric": None} for m, v in rmse.items()}
        }

    results = [frame(mine=0.03, good=0.02, bad=0.5), frame(mine=0.05, good=0.04, bad=0.6)]
    text = evaluate.against_best(results, "mine", ("bad", "good"))
    assert "optical: +10.0 [+10.0, +10.0] against good" in text and "bad" not in text


def test_the_best_baseline_is_that_of_the_frames_which_all_complete():
    def frame(**rmse):
        scores = {m: v and {"optical": {"rmse": v}, "optical_valid": None, "geometric": None} for m, v in rmse.items()}
        return {"methods": scores}

    results = [frame(mine=0.01, lazy=0.012, best=0.008), frame(mine=0.10, lazy=None, best=0.09)]
    assert "+2.0 [+2.0, +2.0] against best" in evaluate.against_best(results, "mine", ("lazy", "best"))
    apart = [frame(mine=None, lazy=0.012), frame(mine=0.1, lazy=None)]
    assert "against" not in evaluate.against_best(apart, "mine", ("lazy",))


def test_a_method_in_another_unit_is_told_and_one_without_frames_is_named():
    with pytest.raises(RuntimeError, match="your method 'fill' returns depth about 700: metres are expected"):
        evaluate.within_its_lines("fill", lambda *_: np.full((4, 4), 700.0))(None, None, None)
    for given in (None, np.zeros((2, 2)), np.full((2, 2), 0.7)):  # others judge what is no depth map
        assert evaluate.within_its_lines("fill", lambda *_, given=given: given)(None, None, None) is given
    nothing = [{"methods": {"mine": None, "good": {"optical": {"rmse": 1.0}}}}]
    assert (
        evaluate.against_best(nothing, "mine", ("good",))
        == "mine and a baseline have no frame in common to be compared on"
    )


def test_an_interval_of_few_frames_is_not_called_one(capsys):
    evaluate.say_if_few(6)
    assert not capsys.readouterr().out
    evaluate.say_if_few(2)
    assert capsys.readouterr().out.startswith("2 frames are too few for an interval")


@pytest.mark.parametrize(
    ("argv", "reason"),
    [
        (["evaluate", "--depth-scale", "0.1"], "--depth-scale is of --dataset folder"),
        (["evaluate", "--steps", "0"], "--steps: expected at least 1"),
        (["evaluate", "--seed", "1"], "unrecognized arguments"),
        (["simulate", "--workers", "-1"], "--workers: expected 1 to 256"),
        (["simulate", "--split", "test", "--count", "1", "--first-seed", "-1"], "--first-seed: expected 0 to"),
        (["simulate", "--export-as", "folder", "x", "--count", "-1"], "--count: expected at least 1"),
        (["train", "--lr", "1e9"], "--lr: expected a learning rate between 0 and 1"),
        (["train", "--lr", "nan"], "--lr: expected a learning rate"),
        (["train", "--seed", str(2**63)], "--seed: expected 0 to"),
        (["train", "--set", "region.levels=12"], "region: expected at most 6, got levels 12"),
        (["train", "--set", "unet.width=100000"], "unet: expected at most 512"),
        (["bench", "--runs", "0"], "--runs: expected at least 1"),
        (["bench-boundary", "--tolerance", "-2"], "--tolerance: expected pixels"),
        (["complete", "--seed", str(2**63)], "--seed: expected 0 to"),
        (["complete", "--depth-scale", "inf"], "--depth-scale: expected metres per unit above 0"),
    ],
)
def test_numbers_beyond_their_limits_are_refused_before_anything_is_loaded(argv, reason, capsys, monkeypatch):
    monkeypatch.setattr("ditr_lite.pipeline.Ditr.from_pretrained", None)
    assert main(argv) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and reason in lines[0], lines


def test_simulate_never_writes_among_other_things(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("ditr_lite.simulator.simulate.simulate_many", None)
    (tmp_path / "test").mkdir()
    (tmp_path / "test" / "thesis.tex").write_text("years of work")
    assert main(["simulate", "--split", "test", "--count", "1", "--out", str(tmp_path)]) == 2
    assert "holds something else than scenes of test, thesis.tex" in capsys.readouterr().err
    (tmp_path / "test").rename(tmp_path / "work")
    assert main(["simulate", "--split", "test", "--count", "1", "--out", str(tmp_path)]) == 2
    assert "holds something else than scenes, work" in capsys.readouterr().err


def test_training_never_writes_among_other_things(tmp_path, scenes, capsys):
    (tmp_path / "holiday.jpg").write_bytes(b"x")
    for name in ("--out", "--work"):
        assert main(["train", "--data", str(scenes / "val"), name, str(tmp_path)]) == 2
        assert "holds something else than weights and checkpoints, holiday.jpg" in capsys.readouterr().err


def test_an_interruption_ends_with_one_line(monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("ditr_lite.cli.evaluate.check_results", interrupt)
    assert main(["evaluate"]) == 130
    assert capsys.readouterr().err == "ditr_lite: interrupted\n"


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("boom\nboom"), ImportError("no torch"), OSError("full")])
def test_errors_of_every_kind_end_with_one_line(monkeypatch, capsys, error):
    def fail(*_):
        raise error

    monkeypatch.setattr("ditr_lite.cli.evaluate.check_results", fail)
    assert main(["evaluate"]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
