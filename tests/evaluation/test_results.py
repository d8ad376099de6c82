import json

import pytest
import torch

from ditr_lite import store
from ditr_lite.config import override, preset, to_dict
from ditr_lite.evaluation import results


@pytest.fixture
def weights(tmp_path):
    for name in ("region", "optical"):
        store.save_part(name, {"x": torch.zeros(2)}, preset("tiny"), tmp_path / "w", {"name": name})
    return tmp_path / "w"


def test_a_file_says_how_to_make_it_again_and_with_which_weights(weights, tmp_path):
    line = results.tool_command("some_study", ["--split", "val", "--out", tmp_path / "a b"])
    assert line.startswith("python tools/some_study.py --split val --out '")
    begin = results.head(line, weights, split="val")
    assert begin["weights_sha256"] == {n: store.sha256(weights / f"{n}.safetensors") for n in ("region", "optical")}
    assert begin["split"] == "val" and begin["versions"]["torch"] == torch.__version__
    results.write(tmp_path / "results_some.json", begin, {"rows": [1, 2]})
    found = results.read("some", tmp_path)
    assert list(found) == ["command", "weights_sha256", "settings_sha256", "versions", "split", "rows"]
    assert found["rows"] == [1, 2]
    assert found == json.loads(results.results_path("some", tmp_path).read_text())


def test_results_are_current_until_the_weights_change(weights):
    only = results.head("c", weights, ["region"])
    assert list(only["weights_sha256"]) == ["region"] and results.is_current(only, weights)
    both = results.head("c", weights)
    store.save_part("optical", {"x": torch.ones(2)}, preset("tiny"), weights, {})
    assert results.is_current(only, weights) and not results.is_current(both, weights)


def test_results_of_a_part_that_these_weights_lack_are_outdated(weights):
    report = results.head("c", weights)
    report["weights_sha256"]["detail"] = "0" * 64
    assert results.outdated(report, weights) == ["detail"] and not results.is_current(report, weights)


def test_results_are_current_until_the_settings_change(weights):
    begin = results.head("c", weights)
    assert results.outdated(begin, weights) == []
    card = store.read_card(weights)
    changed = card | {"config": to_dict(override(preset("tiny"), **{"std.kept": 0.5}))}
    (weights / store.CARD).write_text(json.dumps(changed))
    assert results.is_current(begin, weights)  # the fit of the expected error is told apart
    changed = card | {"config": to_dict(override(preset("tiny"), **{"sampler.steps": 3}))}
    (weights / store.CARD).write_text(json.dumps(changed))
    assert results.outdated(begin, weights) == ["settings"]
    spare = to_dict(preset("tiny"))
    del spare["sampler"]["objective"], spare["schedule"]  # a card that was written before there were these settings
    (weights / store.CARD).write_text(json.dumps(card | {"config": spare}))
    assert results.outdated(begin, weights) == []
    (weights / store.CARD).write_text(json.dumps(changed))
    del begin["settings_sha256"]  # as older files are
    assert results.is_current(begin, weights)


def test_what_is_not_there_is_named(weights, tmp_path):
    with pytest.raises(ValueError, match="holds no sonar; it has region, optical"):
        results.head("c", weights, ["region", "sonar"])
    with pytest.raises(ValueError, match="no results in .*results_nothing.json"):
        results.read("nothing", tmp_path)


def test_provenance_says_which_weights(weights, monkeypatch):
    report = results.head("make it", weights)
    monkeypatch.setattr(results, "is_current", lambda _: True)
    assert results.provenance(report) == "made with these weights; again: make it"
    monkeypatch.setattr(results, "is_current", lambda _: False)
    assert results.provenance(report).startswith("MADE WITH OTHER WEIGHTS")
    assert results.provenance({"command": "c"}) == "made with networks of its own; again: c"
