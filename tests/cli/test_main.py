import json
import re
import shlex
import shutil
import subprocess
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ditr_lite import data, files, store
from ditr_lite.cli import main, parser, shared
from ditr_lite.cli.evaluate import DATASETS
from ditr_lite.cli.train import folders
from ditr_lite.config import preset
from ditr_lite.evaluation import timing
from ditr_lite.training import recipes

ROOT = Path(__file__).resolve().parents[2]
REAL = ROOT.parent / "shared" / "real"
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason="no real frames beside the repository")
SHAPE = (64, 96)  # of the frames in conftest.py


def arguments(folder, weights, out, **changes):
    values = {"rgb": folder / "a.png", "depth": folder / "b.png", "out": out, "weights": weights}
    values |= {"steps": 1, "samples": 1} | changes
    given = [(f"--{k.replace('_', '-')}", v) for k, v in values.items() if v is not None]
    return ["complete", *(str(word) for pair in given for word in pair)]


def refused(argv, capsys):
    """Run a command line that must be refused and return the reason."""
    assert main(argv) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("ditr_lite: error: ")
    return lines[0].removeprefix("ditr_lite: error: ")


@pytest.mark.parametrize("suffix", [".png", ".PNG", ".tif", ".npy", ".exr"])
def test_complete_writes_dense_depth_and_keeps_readings(frame, weights, tmp_path, suffix, capsys):
    out = tmp_path / "new" / f"c{suffix}"
    assert main(arguments(frame, weights, out, region=frame / "m.png")) == 0
    raw, region, depth = files.read_depth(frame / "b.png"), files.read_mask(frame / "m.png"), files.read_depth(out)
    keep = (raw > 0) & ~region
    assert (depth > 0).all() and np.array_equal(depth[keep], raw[keep])
    assert f"96 x 64, {depth.min():.3f}" in capsys.readouterr().out


def test_complete_writes_cloud_and_picture(frame, woken, tmp_path):
    cv2.imwrite(str(frame / "b.png"), np.random.default_rng(0).integers(500, 700, SHAPE).astype(np.uint16))
    ply, panel = tmp_path / "c.ply", tmp_path / "c_panel.png"
    extra = {"ply": ply, "panel": panel, "intrinsics": frame / "K.txt", "seed": 3, "region": frame / "m.png"}
    assert main([*arguments(frame, woken, tmp_path / "c.npy", **extra), "--adjust"]) == 0
    assert f"element vertex {SHAPE[0] * SHAPE[1]}".encode() in ply.read_bytes()[:400]
    assert cv2.imread(str(panel)).ndim == 3
    raw, region = files.read_depth(frame / "b.png"), files.read_mask(frame / "m.png")
    assert (np.load(tmp_path / "c.npy") != raw)[(raw > 0) & ~region].mean() > 0.9
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.npy", "c.ply", "c_panel.png", "in"]


def grey(folder):
    cv2.imwrite(str(folder / "a.png"), np.full(SHAPE, 90, np.uint8))


def rgba(folder):
    cv2.imwrite(str(folder / "a.png"), np.full((*SHAPE, 4), 90, np.uint8))


def other_size(folder):
    cv2.imwrite(str(folder / "b.png"), np.full((32, 48), 600, np.uint16))


def eight_bits(folder):
    cv2.imwrite(str(folder / "b.png"), np.full(SHAPE, 60, np.uint8))


def all_missing(folder):
    cv2.imwrite(str(folder / "b.png"), np.zeros(SHAPE, np.uint16))


def nothing_finite(folder):
    depth = np.full(SHAPE, np.nan, np.float32)
    depth[::2], depth[::3] = np.inf, -1
    np.save(folder / "b.npy", depth)


def cut_short(folder):
    (folder / "b.png").write_bytes((folder / "b.png").read_bytes()[:50])


def region_of_another_size(folder):
    cv2.imwrite(str(folder / "m.png"), np.full((32, 48), 255, np.uint8))


def grey_region(folder):
    cv2.imwrite(str(folder / "m.png"), np.full(SHAPE, 50, np.uint8))


def keep(folder):
    pass


@pytest.mark.parametrize(
    ("spoil", "changes", "reason"),
    [
        (keep, {"rgb": "no.png"}, "no file .*no.png"),
        (keep, {"depth": "no.npy"}, "no file .*no.npy"),
        (keep, {"region": "no.png"}, "no file .*no.png"),
        (keep, {"weights": "nowhere"}, "no weights in .*nowhere"),
        (keep, {"depth": "a.png"}, "should hold one depth channel"),
        (keep, {"ply": "c.ply"}, "--ply needs the camera"),
        (keep, {"out": "c.bmp"}, "cannot write .*c.bmp: expected a name ending in .png, .tif, .tiff, .npy, .exr"),
        (keep, {"out": "in/a.png/c.png"}, "cannot write .*is a file, not a folder"),
        (keep, {"panel": "c.jpg"}, "cannot write .*c.jpg"),
        (keep, {"steps": 0}, "steps: expected at least 1, got 0"),
        (keep, {"threshold": 1.5}, "threshold: expected a probability between 0 and 1"),
        (keep, {"refine": "4,3,1"}, "refine: expected odd kernels"),
        (keep, {"refine": "3,3"}, "refine: expected MEDIAN,DILATE,ITERATIONS"),
        (keep, {"samples": 0}, "samples: expected at least 1"),
        (keep, {"steps": "many"}, "invalid int value: 'many'"),
        (keep, {"depth_scale": -1}, "depth-scale: expected metres per unit above 0, got -1"),
        (keep, {"out": None}, "arguments are required: --out"),
        (grey, {}, "a.png is a grey picture"),
        (rgba, {}, "a.png has four channels"),
        (other_size, {}, r"b.png is \(32, 48\), .*a.png \(64, 96\).*give --upsample-depth"),
        (eight_bits, {}, "b.png has 8 bits a pixel"),
        (all_missing, {}, "b.png holds no valid depth"),
        (nothing_finite, {"depth": "b.npy"}, "b.npy holds no valid depth"),
        (cut_short, {}, "cannot read .*b.png"),
        (region_of_another_size, {"region": "m.png"}, r"m.png is \(32, 48\)"),
        (grey_region, {"region": "m.png"}, "m.png should be a mask"),
    ],
)
def test_bad_input_is_named_and_nothing_is_written(spoil, changes, reason, frame, weights, tmp_path, capsys):
    spoil(frame)
    places = {"rgb": frame, "depth": frame, "region": frame, "weights": tmp_path}
    paths = {"rgb", "depth", "region", "weights", "out", "ply", "panel"}
    changes = {k: places.get(k, tmp_path) / v if k in paths and v else v for k, v in changes.items()}
    before = sorted(tmp_path.rglob("*"))
    message = refused(arguments(frame, **{"weights": weights, "out": tmp_path / "c.png"} | changes), capsys)
    assert re.search(reason, message), message
    assert sorted(tmp_path.rglob("*")) == before


def test_odd_readings_count_as_missing(frame, weights, tmp_path):
    depth = np.full(SHAPE, 0.6, np.float32)
    depth[:5], depth[5:10], depth[10:15], depth[15:20] = np.nan, np.inf, -np.inf, -0.4
    np.save(frame / "b.npy", depth)
    assert main(arguments(frame, weights, tmp_path / "c.npy", depth=frame / "b.npy", region=frame / "m.png")) == 0
    out = np.load(tmp_path / "c.npy")
    assert np.isfinite(out).all() and (out > 0).all() and (out[40:] == np.float32(0.6)).all()


@pytest.mark.parametrize("name", ["optical.safetensors", "card.json"])
def test_damaged_weights_are_refused(name, frame, weights, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(weights, copy)
    content = bytearray((copy / name).read_bytes())
    for k in range(len(content) // 2, len(content) // 2 + 16):
        content[k] ^= 0xFF
    (copy / name).write_bytes(content)
    message = refused(arguments(frame, copy, tmp_path / "c.png"), capsys)
    assert name in message and ("damaged" in message or "checksum" in message)
    assert not (tmp_path / "c.png").exists()


def test_weights_that_do_not_fit_their_card_are_refused(frame, weights, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(weights, copy)
    card = json.loads((copy / "card.json").read_text())
    card["config"]["unet"]["width"] = 16
    (copy / "card.json").write_text(json.dumps(card))
    assert "optical weights do not fit" in refused(arguments(frame, copy, tmp_path / "c.png"), capsys)
    (copy / "card.json").write_text("[]")
    assert "should hold a JSON object" in refused(arguments(frame, copy, tmp_path / "c.png"), capsys)


def test_evaluate_prints_tables_and_writes_json(scenes, weights, tmp_path, capsys):
    argv = ["evaluate", "--root", str(scenes), "--limit", "2", "--steps", "1", "--samples", "1"]
    argv += ["--weights", str(weights), "--json", str(tmp_path / "new" / "e.json")]
    assert main(argv) == 0
    printed = capsys.readouterr().out
    assert "test split, region found by stage one" in printed and "keep_and_fill_debiased" in printed
    values = json.loads((tmp_path / "new" / "e.json").read_text())
    assert values["command"] == "python -m ditr_lite " + " ".join(argv)
    assert values["weights_sha256"]["detail"] == store.sha256(weights / "detail.safetensors")
    assert list(values["rmse_m"]) == ["test_00000", "test_00001"] and values["summary"]["kept"]


def test_bench_adds_a_readers_method_and_what_everything_costs(scenes, weights, tmp_path, capsys, monkeypatch):
    speed = {"part": "optical", "batch": 8, "steps_per_s": 1.0, "frames_per_s": 8.0}
    monkeypatch.setattr(timing, "throughput", lambda ditr: speed)
    monkeypatch.setattr(timing, "compare_unets", lambda ditr, runs: dict.fromkeys(["ours"], UNET))
    monkeypatch.setattr(timing, "stage_peaks", lambda *_: defaultdict(lambda: 1.0))
    (tmp_path / "half.py").write_text("def half_a_metre(rgb, depth, region):\n    return 0 * depth + 0.5\n")
    monkeypatch.chdir(tmp_path)
    argv = ["bench", "--root", str(scenes), "--limit", "1", "--steps", "1", "--samples", "1", "--runs", "5"]
    argv += ["--method", "half:half_a_metre", "--weights", str(weights), "--given-region", "--json", "b.json"]
    assert main(argv) == 0
    printed = capsys.readouterr().out
    assert "stage two: geometric branch" in printed and "half_a_metre" in printed and "1280 x 720" in printed
    written = json.loads((tmp_path / "b.json").read_text())
    assert [frame["stages"][-1]["stage"] for frame in written["cost"]["frames"]] == ["whole", "whole"]
    assert written["cost"]["frames"][1]["size"] == [720, 1280]
    assert written["cost"]["frames"][0]["stages"][0]["gflops"] > 0 and written["cost"]["training"] == speed
    assert "half_a_metre" in written["summary"]["differences"]


UNET = {"parameters": 1000, "gflops": 1.0, "ms": 2.0, "ms_per_gflop": 2.0}


@pytest.mark.parametrize(
    ("argv", "reason"),
    [
        ([], "required: COMMAND"),
        (["fly"], "invalid choice: 'fly'"),
        (["evaluate", "--split", "west"], "unknown split 'west'"),
        (["evaluate", "--limit", "0"], "--limit: expected at least 1"),
        (["evaluate", "--dataset", "todd"], "--dataset todd needs --root"),
        (["evaluate", "--dataset", "todd", "--root", "nowhere"], "no TODD frames in nowhere"),
        (["evaluate", "--dataset", "nyu", "--root", "."], "unknown dataset 'nyu'; choose one of cleargrasp"),
        (["evaluate", "--json", "e.txt"], "cannot write e.txt: expected a name ending in .json"),
        (["simulate", "--count", "3"], "--count needs --split"),
        (["simulate", "--sensor", "d435"], "--sensor needs --split"),
        (["simulate", "--split", "test"], "--split needs --count"),
        (["simulate", "--split", "test", "--count", "0"], "--count: expected at least 1"),
        (["train", "--part", "wheel"], "unknown part 'wheel'"),
        (["train", "--preset", "vast"], "unknown preset 'vast'"),
        (["train", "--set", "unet.width"], "--set expects key=value"),
        (["train", "--set", "unet.depth=3"], "unknown setting 'unet.depth'"),
        (["train", "--set", "unet.heads=0"], "unet: expected at least 1, got heads 0"),
        (["train", "--data", str(data.SAMPLES / "val"), "--steps", "-5"], "--steps: expected at least 1"),
        (
            ["train", "--data", "nowhere"],
            "no scenes in nowhere: make them with `python -m ditr_lite simulate --split train --count 1500 "
            "--out outputs/scenes --workers 2`",
        ),
    ],
)
def test_bad_command_lines_are_named(argv, reason, capsys):
    assert reason in refused(argv, capsys)


@pytest.mark.parametrize("option", ["--sensor d415", "--out y", "--workers 2", "--first-seed 0", "--infrared 1"])
def test_an_export_takes_no_option_of_rendering(option, tmp_path, capsys):
    argv = ["simulate", "--export-as", "todd", str(tmp_path / "new"), "--count", "1", *option.split()]
    assert f"{option.split()[0]} is for rendering" in refused(argv, capsys)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("count", "told"), [(1, False), (2, True)])
def test_scenes_of_several_cameras_in_one_folder_are_told_of(count, told, tmp_path, capsys):
    argv = ["simulate", "--export-as", "folder", str(tmp_path / "new"), "--count", str(count)]
    assert main(argv) == 0
    assert ("2 cameras took these scenes, and a folder has one" in capsys.readouterr().out) == told


def test_a_dataset_without_truth_is_refused(tmp_path, weights, capsys):
    for folder, suffix, array in (
        ("rgb", ".jpg", np.full((*SHAPE, 3), 90, np.uint8)),
        ("depth", ".png", np.full(SHAPE, 600, np.uint16)),
        ("mask", ".png", np.zeros((*SHAPE, 3), np.uint8)),
    ):
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / f"0{suffix}"), array)
    argv = ["evaluate", "--dataset", "trosd", "--root", str(tmp_path), "--weights", str(weights)]
    assert "trosd in" in (message := refused(argv, capsys)) and "no ground-truth depth" in message


def test_simulate_calls(monkeypatch, tmp_path, capsys):
    calls = []

    def fake(*call):
        calls.append(call)
        return [Path("first"), Path("last")]

    monkeypatch.setattr("ditr_lite.simulator.simulate.simulate_many", fake)
    assert main(["simulate", "--workers", "2"]) == 0
    shipped = (("test", 128, 4), ("val", 48, 2), ("train", 24, 2), ("rooms", 96, 0), ("rooms_val", 48, 0))
    assert calls == [(data.SAMPLES, s, n, 0, 2, i, None) for s, n, i in shipped]
    calls.clear()
    argv = ["simulate", "--split", "val", "--count", "5", "--first-seed", "9", "--infrared", "1", "--workers", "3"]
    assert main([*argv, "--out", str(tmp_path)]) == 0
    assert calls == [(tmp_path, "val", 5, 9, 3, 1, None)]
    calls.clear()
    assert main(["simulate", "--sensor", "l515", "--split", "test", "--count", "1", "--workers", "1"]) == 0
    assert calls == [(Path("outputs/sensors/l515"), "test", 1, 0, 1, 0, "l515")]


def test_train_all_goes_through_the_parts_and_makes_usable_weights(scenes, tmp_path, frame, capsys):
    out, work = tmp_path / "weights", tmp_path / "work"
    argv = ["train", "--preset", "tiny", "--data", str(scenes / "val"), "--val", str(scenes / "test"), "--limit", "2"]
    argv += ["--steps", "1", "--batch", "2", "--lr", "1e-3", "--out", str(out), "--work", str(work)]
    assert main(argv) == 0
    assert set(json.loads((out / "card.json").read_text())["parts"]) == set(recipes.RECIPES)
    assert main(arguments(frame, out, tmp_path / "c.png")) == 0
    capsys.readouterr()
    # other sizes must not be mixed into the same folder
    assert "another unet setting" in refused([*argv, "--part", "optical", "--set", "unet.heads=1"], capsys)
    again = [*argv, "--part", "region", "--set", "region.width=16", "--out", str(tmp_path / "other")]
    assert "region.checkpoint.safetensors belongs to another run, of other settings" in refused(again, capsys)


def test_a_changed_tiny_system_is_compared_with_the_default(scenes, tmp_path, frame, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    argv = ["train", "--preset", "tiny", "--set", "unet.heads=1", "--val", str(scenes / "val"), "--limit", "2"]
    argv += ["--steps", "1", "--batch", "2", "--lr", "1e-3", "--seed", "3"]
    assert main(argv) == 0
    printed = capsys.readouterr().out
    assert "2 scenes to train on, seed 3; trained again: optical, geometric, detail" in printed
    assert "unet.heads=1" in printed and "[95 % interval], paired over frames" in printed
    assert {p.name for p in tmp_path.iterdir()} == {"outputs", frame.name}
    card = json.loads(Path("outputs/weights/tiny/unet.heads=1/card.json").read_text())
    assert card["config"]["unet"]["heads"] == 1 and card["parts"]["optical"]["recipe"]["batch"] == 2
    assert main(arguments(frame, tmp_path / "outputs/weights/tiny/unet.heads=1", tmp_path / "c.png")) == 0
    assert "nothing is changed" in refused([*argv, "--set", "unet.heads=2"], capsys)
    assert "leave out --preset" in refused([*argv, "--start", "outputs/weights"], capsys)


def test_a_comparison_runs_over_several_seeds_and_is_written(scenes, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    argv = ["train", "--preset", "tiny", "--set", "unet.heads=1", "--val", str(scenes / "val"), "--limit", "2"]
    argv += ["--steps", "1", "--batch", "2", "--seed", "3", "--seeds", "2", "--json", "found.json"]
    assert main(argv) == 0
    printed = capsys.readouterr().out
    assert "seed 3" in printed and "seed 4" in printed and "mm apart" in printed
    found = json.loads(Path("found.json").read_text())
    assert found["command"] == shlex.join(["python", "-m", "ditr_lite", *argv]) and found["seeds"] == [3, 4]
    by_seed = [
        np.subtract(*(r["rmse_m"][arm]["geometric"] for arm in ("changed", "default"))).mean() for r in found["runs"]
    ]
    difference = found["difference"]["geometric"]  # an untrained stage one may claim nothing
    assert np.allclose(difference["by_seed"], by_seed)  # one step may leave both arms alike: then 0 twice
    assert found["runs"][0]["rmse_m"]["default"] != found["runs"][1]["rmse_m"]["default"]  # but not both seeds
    assert np.isclose(difference["spread"], np.std(by_seed, ddof=1)) and np.isclose(
        difference["mean"], np.mean(by_seed)
    )
    Path("mine.json").write_text('{"a": 1}')
    for extra, reason in (
        (["--json", "mine.json"], "something else than results"),
        (["--json", "found.txt"], "ending in .json"),
        (["--out", "arm"], "--out is one weights folder"),
        (["--seed", str(2**63 - 1)], "leaves no 2 seeds"),
        (["--part", "optical"], "--seeds and --json are of a comparison"),
        (["--preset", "lite"], "--seeds and --json are of a comparison"),
    ):
        assert reason in refused([*argv, *extra], capsys)


def test_training_never_writes_into_the_shipped_weights_by_itself(scenes, monkeypatch, capsys):
    calls, commands = [], []

    def fake(part, config, data, val, out, work, recipe, command, **how):
        calls.append((out, work, recipe.steps))
        commands.append(command)
        return {"steps": 0, "seconds": 0, "curve": []}

    monkeypatch.setattr("ditr_lite.training.parts.train", fake)
    argv = ["train", "--part", "region", "--data", str(scenes / "val"), "--val", str(scenes / "val"), "--steps", "7"]
    for extra in ([], ["--preset", "tiny"], ["--set", "unet.width=64"]):
        assert main([*argv, *extra]) == 0
    assert calls[0] == (Path("outputs/weights/lite"), Path("outputs/training/lite"), 7)
    assert {str(out) for out, _, _ in calls[1:]} == {"outputs/weights/tiny", "outputs/weights/lite-unet.width=64"}
    assert len({work for _, work, _ in calls}) == 3
    assert commands[2] == shlex.join(["python", "-m", "ditr_lite", *argv, "--set", "unet.width=64"])


def test_a_comparison_does_not_replace_the_shipped_system(tmp_path, capsys):
    shutil.copy(store.WEIGHTS / "card.json", tmp_path)  # a copy, lest the test itself do the damage
    argv = ["train", "--preset", "tiny", "--set", "unet.width=16", "--out", str(tmp_path)]
    settings = "region, autoencoder, unet, detail, size, window, refine.looks"
    assert f"holds weights of another {settings} setting" in refused(argv, capsys)
    assert store.read_card(tmp_path) == store.read_card()


def test_scenes_to_validate_on_are_the_shipped_ones_wherever_it_is_called_from(scenes, tmp_path, monkeypatch):
    seen = []

    def fake(*args, **how):
        seen.append(args[3] if args[0] == "region" else args[1])
        raise ValueError("far enough")

    monkeypatch.setattr("ditr_lite.training.parts.train", fake)
    monkeypatch.setattr("ditr_lite.training.boundary.train_boundary", fake)
    monkeypatch.chdir(tmp_path)
    for command in (["train", "--part", "region"], ["train-boundary"]):
        assert main([*command, "--data", str(scenes / "val")]) == 2
    shipped = [data.SAMPLES / split for split in ("val", "rooms_val") if (data.SAMPLES / split).is_dir()]
    assert seen == [shipped, data.SAMPLES / "val"]


def test_json_is_written_whole_or_not_at_all(tmp_path):
    with pytest.raises(ValueError):
        files.write_json(tmp_path / "x.json", {"value": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_datasets_offered_are_those_that_can_be_read():
    from ditr_lite import datasets

    assert set(DATASETS) == set(datasets.REGISTRY)


COMMANDS = [
    "complete",
    "evaluate",
    "simulate",
    "train",
    "bench",
    "train-boundary",
    "bench-boundary",
    "compare",
    "floor",
]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0 and "usage: python -m ditr_lite" in capsys.readouterr().out


def test_help_imports_nothing_heavy():
    code = "import sys; from ditr_lite.cli import parser; parser(); assert 'numpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_process_ends_with_code_2_and_one_line(tmp_path):
    argv = [sys.executable, "-m", "ditr_lite", "complete", "--rgb", "no.png", "--depth", "no.png", "--out", "c.png"]
    done = subprocess.run(argv, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "ditr_lite: error: no file no.png\n"


@needs_real
def test_a_real_frame_of_a_flat_folder(weights, tmp_path, capsys):
    folder = REAL / "lingbot" / "2"
    argv = arguments(folder, weights, tmp_path / "c.exr", rgb=folder / "rgb.png", depth=folder / "raw_depth.png")
    assert main([*argv, "--ply", str(tmp_path / "c.ply"), "--intrinsics", str(folder / "intrinsics.txt")]) == 0
    assert (
        files.read_depth(tmp_path / "c.exr").shape == (480, 640) and (tmp_path / "c.ply").stat().st_size > 15 * 300_000
    )


def test_readme_shows_the_cost_of_a_training_on_scenes_that_are_shipped(monkeypatch):
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    [line] = [line for line in lines if line.startswith("python -m ditr_lite train") and "--cost" in line]
    monkeypatch.chdir(ROOT)
    data, _ = folders(parser().parse_args(shlex.split(line, comments=True)[3:]))
    assert all(folder.resolve().is_relative_to(ROOT / "data_samples") for folder in data)


def test_the_system_takes_threshold_and_kernels_from_the_command_line(weights):
    def refine_of(*words):
        return shared.load_system(parser().parse_args(["evaluate", "--weights", str(weights), *words])).config.refine

    tiny = preset("tiny").refine
    assert refine_of() == tiny
    assert refine_of("--threshold", "0.3") == replace(tiny, threshold=0.3)
    assert refine_of("--refine", "3,5,2") == replace(tiny, median=3, dilate=5, iterations=2)


def test_a_place_that_takes_no_file_is_refused_before_any_work(tmp_path, monkeypatch):
    def refuse(dir):
        raise PermissionError(13, "Permission denied")

    shared.check_target(tmp_path / "new" / "a.json", ".json")
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(shared, "TemporaryFile", refuse)
    with pytest.raises(ValueError, match=f"cannot write .*a.json: {tmp_path} takes no new file .Permission denied."):
        shared.check_target(tmp_path / "new" / "a.json", ".json")
