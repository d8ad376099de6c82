"""Two weights folders compared: which of both is better, and by how much."""

import pytest

from ditr_lite import metrics
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
