"""tools/: student copies lose exactly the solutions; studies and maps are complete."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import calibrate
import nbformat
import numpy as np
import paper_map
import pytest
import readme_results
import real_frames
import region_study as study
import result_picture as picture
import soak
import student_copy as students
import torch
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output
from safetensors.torch import save_file

from ditr_lite import store
from ditr_lite.config import RefineConfig, StdConfig, preset
from ditr_lite.data import list_samples, load_sample
from ditr_lite.evaluation.statistics import paired_bootstrap
from ditr_lite.pipeline import Ditr, build
from ditr_lite.store import save_part
from ditr_lite.studies import denoisers, peer_tables

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


SOLVED = """def rmse(a, b):
    \"\"\"Root mean square error.\"\"\"
    # BEGIN SOLUTION
    squares = (a - b) ** 2
    return squares.mean() ** 0.5
    # END SOLUTION
print("after")"""


def example():
    stored = [new_output("stream", name="stdout", text="after\n")]
    png = [new_output("display_data", data={"image/png": "iVBORw0KGgo=", "text/plain": "<Figure>"})]
    tags = {"tags": ["nbval-check-output", "keep"]}
    return new_notebook(
        cells=[
            new_markdown_cell("# Score a depth map\n\nSee [the next one](08_ablations.ipynb#top)."),
            new_code_cell(SOLVED, outputs=stored, execution_count=1, metadata=tags),
            new_code_cell("# NBVAL_CHECK_OUTPUT\nprint('after')", outputs=stored, execution_count=2),
            new_code_cell("plot()", outputs=png, execution_count=3, metadata={"alt": "two rising curves"}),
        ]
    )


def test_solution_becomes_a_stub_that_raises():
    source = students.strip_solution(SOLVED)
    assert "squares" not in source and "SOLUTION" not in source
    names = {}
    exec(source, names)  # the rest of the cell still runs
    with pytest.raises(NotImplementedError, match="your turn"):
        names["rmse"](1, 2)


def test_two_solutions_in_one_cell():
    source = students.strip_solution(SOLVED + "\n" + SOLVED.replace("rmse", "mae"))
    assert source.count(students.STUB) == 2 and source.count('print("after")') == 2


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (SOLVED.replace("    # END SOLUTION\n", ""), "never closed"),
        (SOLVED.replace("    # BEGIN SOLUTION\n", ""), "without its partner"),
        (SOLVED.replace("# END SOLUTION", "# BEGIN SOLUTION"), "without its partner"),
        ("# BEGIN SOLUTION\nx = 1\n# END SOLUTION", "outside a function"),
    ],
)
def test_bad_markers_are_refused(source, message):
    with pytest.raises(ValueError, match=message):
        students.strip_solution(source)


def test_copy_differs_only_where_it_should():
    notebook = example()
    student = students.student_copy(notebook)
    assert notebook == example() | {"cells": notebook.cells} and "squares" in notebook.cells[1].source
    text, solved, checked, figure = student.cells
    assert text == notebook.cells[0]
    assert figure == notebook.cells[3] | {"outputs": [], "execution_count": None}
    assert solved.outputs == [] and solved.execution_count is None and solved.metadata.tags == ["keep"]
    assert checked.source == "print('after')" and checked.outputs == [] and checked.execution_count is None


def test_bad_notebook_is_named(tmp_path, capsys):
    nbformat.write(new_notebook(cells=[new_code_cell("    # END SOLUTION")]), tmp_path / "bad.ipynb")
    assert students.main([str(tmp_path / "bad.ipynb"), "--out", str(tmp_path / "out")]) == 1
    assert "bad.ipynb: code cell 0, line 1" in capsys.readouterr().err


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebooks_have_student_copies(path, tmp_path):
    [copy], _ = students.write_copies([path], tmp_path)
    original, student = (nbformat.read(p, as_version=4) for p in (path, copy))
    nbformat.validate(student)
    checkers = [cell for cell in student.cells if cell.metadata.get("nbgrader", {}).get("grade")]
    assert len(student.cells) == len(original.cells) + len(checkers)
    kept = [cell for cell in student.cells if cell not in checkers]
    for before, after in zip(original.cells, kept, strict=True):
        assert students.CHECK_TAG not in after.metadata.get("tags", [])
        solved = before.cell_type == "code" and students.BEGIN in before.source
        assert (students.STUB in after.source) == solved == ("nbgrader" in after.metadata)
        same = {**after, "source": after.source.replace(f"]({students.seen_from(tmp_path)}/", "](../")}
        assert solved or before.cell_type == "code" or before == same
        assert after.get("outputs", []) == []


def test_region_study_tables_have_intervals_and_every_scene():
    rows = {"a": [{"x_m": 0.02, "y_m": None}], "b": [{"x_m": 0.04, "y_m": None}]}
    table = study._table(rows, ["-1"], ("x_m", "y_m"))
    assert table["-1"]["x_m"]["scenes"] == [0.02, 0.04] and table["-1"]["x_m"]["mean"][0] == pytest.approx(0.03)
    assert table["-1"]["y_m"] == {"mean": None, "scenes": [None, None]}


def test_region_study_has_a_control_and_both_ends():
    assert [name for name, (weight, _) in study.VARIANTS.items() if weight == 0] == ["segmentation loss alone"]
    kernels = {(r.median, r.dilate, r.iterations) for r in study.SETTINGS}
    assert {(0, 0, 0), (7, 5, 3)} <= kernels and 0 in study.OFFSETS and min(study.OFFSETS) < 0 < max(study.OFFSETS)


def test_region_results_are_complete():
    result = json.loads((ROOT / "ditr_lite" / "weights" / "results_region.json").read_text())
    assert result["command"].startswith("python tools/region_study.py") and set(result["weights_sha256"]) >= {"region"}
    assert set(result["errors"]) == {str(k) for k in study.OFFSETS} and "7/5/3" in result["refinement"]
    for name in study.VARIANTS:
        run = result["finetuning"][name]
        assert len(run["after"]["optical_m"]) == len(result["names"])
    assert "-1" in study.report(result)


def test_the_paper_map_is_written_and_checked(tmp_path, monkeypatch, capsys):
    assert paper_map.main(["--check"]) == 0
    for folder in ("tests", "notebooks"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    monkeypatch.setattr(paper_map, "ROOT", tmp_path)
    assert paper_map.main(["--check"]) == 1 and "out of date" in capsys.readouterr().err
    assert paper_map.main([]) == 0 and paper_map.main(["--check"]) == 0
    assert (tmp_path / "PAPER_MAP.md").read_text() == (ROOT / "PAPER_MAP.md").read_text()


def test_the_picture_shows_scenes_by_rank_and_cuts_them_to_what_matters():
    errors = {f"s{k}": {"ditr": {"optical": 0.01 * k}} for k in range(9)} | {"bare": {"ditr": {"optical": 9.0}}}
    share = dict.fromkeys(errors, 0.06) | {"bare": 0.01}
    assert picture.chosen(errors, share) == ["s2", "s4", "s6"]
    region = np.zeros((192, 256), bool)
    region[100:150, 200:250] = True
    rows, cols = picture.cut(region)
    assert region[rows, cols].sum() == region.sum()
    assert 3 * (cols.stop - cols.start) == pytest.approx(4 * (rows.stop - rows.start), abs=4)
    assert rows.stop <= 192 and cols.stop <= 256 and rows.start > 50


def test_the_picture_is_drawn():
    sample = load_sample(list_samples("test")[0])
    drawn = picture.draw([sample], [sample.depth_gt])
    titles = [axes.get_title() for axes in drawn.axes]
    assert sample.name in titles[0] and "DITR: 0 mm off in glass" in titles and drawn.png()[:4] == b"\x89PNG"


def test_calibration_fits_checks_and_enters_what_it_found(tmp_path, capsys):
    torch.manual_seed(2)  # what an untrained network claims is chance: here a sixth of the picture
    config = replace(preset("tiny"), std=StdConfig(base=(0.5, 0.5)), refine=RefineConfig(0, 0, 0))
    parts, sample = build(config), load_sample(list_samples("val")[0])
    _, classes = Ditr(parts, config).classify(sample.rgb, sample.depth)
    parts["region"].classify.bias.data[0] += float(np.median(np.log((1 - classes[0]) / classes[0])))  # claims a half
    for name, part in parts.items():
        save_part(name, part.state_dict(), config, tmp_path / "w", {})
    argv = ["--fit", "val", "--check", "val", "--limit", "1"]
    argv += ["--weights", tmp_path / "w", "--json", tmp_path / "c.json"]
    assert calibrate.main([*map(str, argv), "--enter"]) == 0
    result, entered = json.loads((tmp_path / "c.json").read_text()), Ditr.from_pretrained(tmp_path / "w").config
    assert entered.std == StdConfig(*(tuple(v) if isinstance(v, list) else v for v in result["std"].values()))
    assert entered.refine.temperature == result["refine"]["temperature"] > 0 and entered.std != config.std
    assert replace(entered, std=config.std, refine=config.refine) == config
    assert result["val"]["frames"] == 1 and set(result["val"]["calibrated"]) == {"optical", "geometric", "kept"}
    assert result["command"].startswith("python tools/calibrate.py --fit val") and result["weights_sha256"]
    assert "for config.PRESETS" in capsys.readouterr().out


def test_kept_readings_are_calibrated_by_what_stage_one_says():
    rng = np.random.default_rng(0)
    depth, doubt = rng.uniform(0.5, 1, 20_000), rng.random(20_000)
    error = depth * np.sqrt(0.01**2 + doubt * 0.05**2) * rng.normal(size=20_000)
    rows = {name: np.stack([error, 0.01 * depth, depth, 0 * depth]) for name in ("optical", "geometric")}
    std = calibrate.fitted_std(rows | {"kept": np.stack([error, 0 * depth, depth, doubt])})
    assert std.missed == pytest.approx(0.05, rel=0.1) and std.kept == pytest.approx(0.01, abs=0.006)


def test_the_disturbance_table_goes_into_the_readme():
    row = {"ratio": [1.1, 1.0, 1.2]}
    sparse = {"ratio": [2.0, 1.9, 2.1], "of_linear": [0.8, 0.7, 0.9]}
    table = {"turned by 90": {"found": row, "given": row}, "300 readings": {"found": sparse, "given": sparse}}
    found = {"disturbed_m": [0.2, 0.1, None], "undisturbed_m": [0.1, 0.1, 0.1]}
    rmse = {"turned by 90": {"found": found}, "300 readings": {"found": {**found, "linear_m": [0.3, 0.2, 0.1]}}}
    rooms = {"frames": ["a", "b", "c"], "table": table, "rmse_m": rmse}
    text = readme_results.disturbances({"command": "python x", "disturbances": {"rooms": rooms}})
    assert "| rooms, 3 scenes |" in text and "`python x`" in text
    assert "| turned by 90 | 1.10 [1.00, 1.20] | 1.10 [1.00, 1.20] | 1 of 2 |" in text
    assert "| 300 readings | 0.80 [0.70, 0.90] | 0.80 [0.70, 0.90] | 0 of 2 |" in text
    card = {"parts": {"a": {"steps": 2, "seconds": 60, "scenes": {"x": 3, "y": 4}}, "encoder": {"sha256": "0"}}}
    assert "| a | 7 | 2 | 1 |" in readme_results.training(card) and "encoder" not in readme_results.training(card)


def test_the_readme_compares_the_sensor_on_the_same_pixels_only():
    row = {"optical": [-0.02, -0.03, -0.01], "optical_valid": [-0.03, -0.04, -0.02]}
    *_, raw, sensor = readme_results.minus({"raw": row, "sensor": row}, tuple(row))
    assert raw == "| raw | -20.0 [-30.0, -10.0] | -30.0 [-40.0, -20.0] |"
    assert sensor == "| sensor | – | -30.0 [-40.0, -20.0] |"


def test_scenes_without_glass_are_told_apart_from_what_stage_one_finds():
    found = {"a": {"iou": 0.6, "miss_rate": 0.1}, "b": {"iou": 0.6, "miss_rate": 0.2}}
    bare = {"c": {"iou": 0.0, "miss_rate": None}, "d": {"iou": None, "miss_rate": None}}
    summary = {"stage_one": {"iou": [0.4, 0.0, 0.6], "miss_rate": [0.15, 0.1, 0.2], "area_ratio": [1.0, 1.0, 1.0]}}
    text = readme_results.stage_one({"summary": summary, "stage_one": found | bare})
    assert "union 0.60 [0.60, 0.60] before refinement, in scenes with glass or metal; of the 2 without" in text
    assert "claims something in 1. After it, 15 [10, 20] %" in text
    assert "without" not in readme_results.stage_one({"summary": summary, "stage_one": found})


def test_the_range_of_three_real_frames_is_not_called_an_interval():
    errors = {"ditr": [0.010, 0.030, 0.020], "raw": [0.030, 0.031, 0.030]}
    frames = {f: {"rmse_m": {m: dict.fromkeys(readme_results.SETS, e[f]) for m, e in errors.items()}} for f in range(3)}
    given = {"claimed": 0.1, "missed": 0.1, "area": 1.0, "moved": 0.0}
    pairs = {"raw": {k: paired_bootstrap(errors["ditr"], errors["raw"]) for k in readme_results.SETS}}
    frames = {f"frame {f}": {**row, **given} for f, row in frames.items()}
    text = readme_results.real({"command": "python x", "frames": frames, "differences": pairs})
    assert "| raw | -10.3 [-20.0, -1.0] |" in text and "smallest and the largest" in text and "95 %" not in text
    assert "95 %" in readme_results.spread_over(4)


FRAMES = """
from ditr_lite import load_sample


def frames():
    scene = load_sample("test_00000")
    yield "desk", scene.rgb, scene.depth, scene.depth_gt, scene.region
    yield "hall (no glass)", scene.rgb, scene.depth, None, None
"""


def test_real_frames_of_a_readers_own_file_go_into_the_readme(tmp_path):
    (tmp_path / "mine.py").write_text(FRAMES, encoding="utf-8")
    assert real_frames.main([str(tmp_path / "mine.py"), "--json", str(tmp_path / "results.json")]) == 0
    result = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    desk, hall = result["frames"].values()
    assert set(desk["rmse_m"]) == {"ditr", real_frames.GIVEN, *real_frames.BASELINES}
    assert 0 <= desk["missed"] < 1 and hall["missed"] is hall["area"] is hall["rmse_m"] is None
    assert desk["claimed"] == hall["claimed"] and desk["moved"] < hall["moved"]  # the true region may move
    minus = desk["rmse_m"]["ditr"]["optical"] - desk["rmse_m"]["raw"]["optical"]
    assert result["differences"]["raw"]["optical"] == pytest.approx([minus] * 3, abs=1e-6)
    text = readme_results.real(result)
    assert "1 frames" in text and "| hall (without glass) |" in text and "`python tools/real_frames.py mine.py`" in text
    assert real_frames.summarise({"hall": hall}) == {}


def peer_report():
    """Return what tools/peer_study.py would write of two frames."""
    rng = np.random.default_rng(0)
    names = (peer_tables.SHIPPED, peer_tables.EQUAL, *peer_tables.IDEAS, "harmonic", "equal time, true region")
    names += tuple(f"{step}, seed 0" for step in ("BB", "+DP", "+RR"))
    rmse = {f: {n: dict(zip(peer_tables.SETS, rng.uniform(0.01, 0.05, 3), strict=True)) for n in names} for f in "abc"}
    part = {**peer_tables.summarise_peers(rmse), "rmse_m": rmse}
    trained = {"regression-0": {"arm": "regression", "minutes": 1.5, "cpu_seconds": 88.0, "seed": 0, "scenes": 938}}
    settings = {"size": [96, 128]}
    return {"command": "python x", "settings": settings, "trained": trained, "splits": {"test": part, "rooms": part}}


def test_the_peers_go_into_the_readme(monkeypatch):
    monkeypatch.setattr(readme_results, "is_current", lambda result: False)
    text = readme_results.peers(peer_report() | {"real": {"desk": {"ditr": {"moved": 0.01}}}})
    assert "the same 938 scenes for 1.5 min" in text and "128 x 96" in text and "earlier weights" in text
    assert all(f"| {name} | {says} |" in text for name, says in peer_tables.IDEAS.items())
    assert text.count("+DP after BB, optical, per training seed") == 2 and "1 others" in text


def test_the_readme_begins_with_one_table_of_all_kinds_of_frames():
    rmse = {"ditr": 0.02, "raw": 0.05, "harmonic": 0.03, "keep_and_fill": 0.021, "keep_and_fill_debiased": 0.04}
    away, same = [-0.01, -0.02, -0.005], [-0.001, -0.002, 0.001]
    report = {
        "images": 7,
        "methods": {name: {key: {"rmse": m} for key in readme_results.IN_BRIEF} for name, m in rmse.items()},
        "differences": {n: {"optical": away, "geometric": same} for n in rmse if n != "ditr"},
        "stage_one": {"miss_rate": [0.12, 0.09, 0.15]},
    }
    split = {"summary": report}
    errors = {name: {"optical": m, "geometric": None} for name, m in rmse.items()}
    frames = {"a": {"rmse_m": errors, "claimed": 0.1}, "b (no glass)": {"rmse_m": None, "claimed": 0.036}}
    text = readme_results.brief({"Table tops": split}, frames)
    assert "| `ditr`: this repository | 20.0 | 20.0 | 20.0 | – |" in text  # DITR is compared with the others only
    assert "| `raw`: the sensor; holes take the nearest reading | 50.0 | 50.0 = | 50.0 | – |" in text
    assert "7 table tops, 1 real frames" in text and "12 [9, 15] % (table tops)" in text
    assert "Of 1 real frames without glass it claims 3.6 to 3.6 %" in text
    alone = readme_results.brief({"Table tops": split}, {})
    assert "real" not in alone


def test_long_sections_are_folded_under_their_first_paragraph():
    text = readme_results.folded("**What.** Why.\n\n| a |\n|---|\n\nCommand.", "Table")
    assert text.startswith("**What.** Why.\n\n<details><summary>Table</summary>\n\n| a |")
    assert text.endswith("Command.\n\n</details>")


def test_the_variants_of_the_denoiser_go_into_the_readme():
    ways = [denoisers.way_of(*asked) for asked in denoisers.ASKED]
    errors = {"default": dict.fromkeys(ways, np.full(4, 0.02)), "eps": dict.fromkeys(ways, np.full(4, 0.03))}
    report = {"minutes": 1.5, "scenes": 938, "summary": denoisers.summarise_denoisers(errors), "command": "python x"}
    report["weights_sha256"] = {"autoencoder": "0", "detail": store.read_card()["parts"]["detail"]["sha256"]}
    text = readme_results.variants(report)
    assert "1.5 min" in text and "938 scenes" in text and "`python x`" in text
    assert "Made with earlier weights of autoencoder." in text
    assert denoisers.DENOISERS["eps"].says in text and "+1.00 [+1.00, +1.00]" in text


def test_a_check_that_there_is_not_is_said(capsys):
    with pytest.raises(SystemExit):
        soak.main(["--only", "tea"])
    assert "no check is called like 'tea'; there are" in capsys.readouterr().err


ANYWHERE = (soak.two_runs, soak.weights_damaged, soak.training_not_finite, soak.training_damaged, soak.caches_damaged)
POSIX = (soak.disk_is_full, soak.folder_is_read_only, soak.training_killed)


@pytest.mark.parametrize("check", [*ANYWHERE, *POSIX])
def test_what_breaks_programs_does_not_break_this_one(check, monkeypatch):
    if check in POSIX and sys.platform == "win32":
        pytest.skip("Windows limits no file's size, and has other permissions and signals")
    monkeypatch.setattr(soak, "DAMAGES", 24)
    monkeypatch.setattr(soak, "TRAINING_KILLS", 2)
    monkeypatch.setattr(soak, "PART", "autoencoder")
    monkeypatch.setattr(soak, "STEPS", 20)
    found = soak.run(check, 0)
    assert found["right"] == found["tried"] > 1, found


def test_what_a_killed_writer_leaves_is_no_checkpoint(tmp_path):
    (tmp_path / "work").mkdir()
    save_file({"a": torch.ones(2)}, tmp_path / "work" / "run.safetensors")
    (tmp_path / "work" / ".run.0123456789ab.part.safetensors").touch()
    assert list(soak.bits(tmp_path)) == ["run.safetensors a"]


def test_a_check_that_fails_or_raises_is_counted_as_wrong(monkeypatch, capsys):
    def half(folder, rng):
        """Half of it is right."""
        return soak.row([True, False], "1 mm")

    def broken(folder, rng):
        """It raises."""
        raise OSError("no\nspace")

    monkeypatch.setattr(soak, "CHECKS", (half, broken))
    assert soak.main([]) == 1
    assert "1 of   2 right" in (printed := capsys.readouterr().out) and "OSError: no space" in printed
    table = readme_results.soak({"command": "x", "checks": [soak.run(half, 0)]})
    assert "| Half of it is right | 1 of 2 | 1 mm |" in table
