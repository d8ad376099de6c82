import csv
import json
import sys

import pytest

from ditr_lite.training.logs import to_csv, to_tensorboard

CURVE = [{"step": 5, "seconds": 0.5, "total": 2.0}, {"step": 10, "seconds": 1.0, "total": 1.5, "val_error": 0.25}]


@pytest.fixture(params=["rows", "file"])
def curve(request, tmp_path):
    if request.param == "rows":
        return CURVE
    log = tmp_path / "part.jsonl"
    log.write_text("".join(json.dumps(row) + "\n" for row in CURVE))
    return log


def test_a_curve_becomes_a_table(curve, tmp_path):
    to_csv(curve, tmp_path / "out" / "curve.csv")
    with (tmp_path / "out" / "curve.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows[1] == {"step": "10", "seconds": "1.0", "total": "1.5", "val_error": "0.25"}
    assert rows[0]["val_error"] == "" and len(rows) == 2


def test_a_curve_becomes_event_files(curve, tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    to_tensorboard(curve, tmp_path / "events")
    events = accumulator.EventAccumulator(str(tmp_path / "events")).Reload()
    assert [(e.step, e.value) for e in events.Scalars("total")] == [(5, 2.0), (10, 1.5)]
    assert [(e.step, e.value) for e in events.Scalars("val_error")] == [(10, 0.25)]


def test_what_is_missing_is_said(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="is no log of a training"):
        to_csv(tmp_path / "none.jsonl", tmp_path / "out.csv")
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ImportError, match=r"pip install -e '.\[logs\]'"):
        to_tensorboard(CURVE, tmp_path)
