"""Two weights folders compared: which of both is better, and by how much."""

import pytest

from ditr_lite import metrics
from ditr_lite.config import preset
from ditr_lite.evaluation import compare

ERRORS = {"good": (0.01, 0.02, 0.03), "bad": (0.03, 0.05, 0.04)}


def test_the_second_folder_is_held_against_the_first(monkeypatch):
    monkeypatch.setattr(compare.Ditr, "from_pretrained", lambda path: path)

    def run(samples, folder, methods, given):
        row = {key: {"rmse": None} for key in metrics.SETS}
        return [
            {"name": f"frame {k}", "methods": {"ditr": row | {"whole": {"rmse": error}}}}
            for k, error in enumerate(ERRORS[folder])
        ]

    monkeypatch.setattr(compare, "run_methods", run)
    found = compare.compare_weights("good", "bad", [])
    assert found["difference"]["whole"][0] == pytest.approx(0.02) and found["ratio"]["whole"][0] == pytest.approx(2)
    assert found["difference"]["whole"][1] > 0 and found["difference"]["optical"] is None
    worse, better = (compare.format_weights(found, "good", "bad"), compare.compare_weights("bad", "good", []))
    assert better["difference"]["whole"][2] < 0 and "+20.0" in worse


def test_only_the_second_system_works_otherwise(monkeypatch):
    asked = []

    class System:
        def __init__(self, path):
            self.config = preset("tiny")

    def run(samples, ditr, methods, given):
        asked.append(ditr.config)
        return [{"name": "a", "methods": {"ditr": {key: {"rmse": 1.0} for key in metrics.SETS}}}]

    monkeypatch.setattr(compare.Ditr, "from_pretrained", System)
    monkeypatch.setattr(compare, "run_methods", run)
    compare.compare_weights(None, None, [], settings={"sampler.steps": "7", "refine.threshold": "0.25"})
    first, second = asked
    assert first == preset("tiny") and second.sampler.steps == 7 and second.refine.threshold == 0.25
    with pytest.raises(ValueError, match=r"autoencoder.width shapes the weights.*expected sampler.steps"):
        compare.compare_weights(None, None, [], settings={"autoencoder.width": "8"})


@pytest.mark.parametrize("given", [False, True])
def test_both_systems_find_the_region_or_are_given_it(monkeypatch, given):
    asked = []

    def run(samples, folder, methods, given_region):
        asked.append((folder, given_region))
        return [{"name": "a", "methods": {"ditr": {key: {"rmse": 1.0} for key in metrics.SETS}}}]

    monkeypatch.setattr(compare.Ditr, "from_pretrained", lambda path: path)
    monkeypatch.setattr(compare, "run_methods", run)
    compare.compare_weights("one", "two", [], given)
    assert asked == [("one", given), ("two", given)]


def test_a_setting_that_there_is_not_is_called_unknown():
    with pytest.raises(ValueError, match="unknown"):
        compare.compare_weights(None, None, [], settings={"sampler.step": "4"})
