"""What ``bench`` refuses before it scores anything; what it measures is tested with the other commands."""

import pytest

from ditr_lite.cli import main
from ditr_lite.evaluation import scoring
from ditr_lite.studies import peer_tables


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


def test_the_table_of_peers_is_printed_and_nothing_scored(capsys, monkeypatch):
    halves = {f"bb_{k}": {"arm": "bb", "seed": 0, "minutes": 0.75} for k in range(2)}
    report = {"command": "python tools/peer_study.py", "splits": {}, "trained": halves}
    monkeypatch.setattr(peer_tables, "load_results", lambda: report)
    monkeypatch.setattr(peer_tables, "format_study", lambda given: "the table" if given is report else "another")
    assert main(["bench", "--peers"]) == 0
    said = capsys.readouterr().out
    assert said == "the table\n\nCommand: python tools/peer_study.py, after python tools/train_peers.py --minutes 1.5\n"
    for more in (["--json", "x.json"], ["--split", "rooms"], ["--no-cost"]):
        assert main(["bench", "--peers", *more]) == 2
        assert f"leave out {more[0]}" in capsys.readouterr().err
