"""What ``bench`` refuses before it scores anything; what it measures is tested with the other commands."""

import pytest

from ditr_lite.cli import main
from ditr_lite.evaluation import scoring


@pytest.mark.parametrize(
    ("argv", "reason"),
    [
        (["--runs", "4"], "--runs should be at least 5, got 4"),
        (["--method", "mine:ditr"], "'ditr' is the name of a row"),
        (["--method", "mine:fill", "--method", "mine:fill"], "two methods are called 'fill'"),
    ],
)
def test_bench_refuses_before_it_scores(tmp_path, capsys, monkeypatch, argv, reason):
    def refuse(*_):
        raise AssertionError("frames were scored")

    monkeypatch.setattr(scoring, "run_methods", refuse)
    (tmp_path / "mine.py").write_text("def fill(rgb, depth, region):\n    return depth\n")
    monkeypatch.chdir(tmp_path)
    assert main(["bench", "--limit", "1", "--json", "b.json", *argv]) == 2
    assert reason in capsys.readouterr().err and not (tmp_path / "b.json").exists()
