"""The transcription: shape, plausibility, and every number against the paper's source where that is at hand."""

import re
from pathlib import Path

import pytest

from ditr_lite.metrics import METRICS
from ditr_lite.paper import tables

SOURCE = Path(__file__).resolve().parents[3] / "shared" / "paper" / "ditr.tex"
needs_source = pytest.mark.skipif(not SOURCE.is_file(), reason="the paper's source is not beside the repository")
LABELS = {
    "T1": "cg_result",
    "T2": "todd_result",
    "T3": "std_result",
    "T4": "ablation",
    "T5": "breakdown",
    "T6": "speed",
}
SPELLING = {"MiDAS": "MiDaS"}  # the paper writes it both ways


def printed(source: str, label: str) -> list[tuple[str, tuple[float, ...]]]:
    """Return (method, numbers) of every row of the table with a label, from LaTeX."""
    (body,) = [
        block
        for block in re.findall(r"\\begin\{table\}.*?\\end\{table\}", source, flags=re.DOTALL)
        if f"\\label{{tab:{label}}}" in block
    ]
    rows = []
    for line in re.split(r"\\\\", body.split(r"\begin{tabular}")[1]):
        line = re.sub(r"\\cite\{[^}]*\}|\\hline|\\cline\{[^}]*\}", "", line)
        line = re.sub(r"\\textbf\{([^}]*)\}", r"\1", line)
        cells = [cell.strip() for cell in line.split("&")]
        numbers = tuple(float(cell) for cell in cells if re.fullmatch(r"[\d.]+", cell))
        if numbers:
            marks = sum("checkmark" in cell for cell in cells)
            name = re.sub(r"\\multi\w+(\{[^}]*\}|\*)*\{([^{}]*)\}", r"\2", " ".join(cells[: len(cells) - len(numbers)]))
            rows.append(("BB + DP + RR"[: 2 + 5 * (marks - 1)] if marks else " ".join(name.split()), numbers))
    return rows


@needs_source
@pytest.mark.parametrize("name", LABELS)
def test_every_number_is_the_paper_s(name):
    found = printed(SOURCE.read_text(encoding="utf-8"), LABELS[name])
    if name == "T6":  # DITR spans two rows
        found = [*found[:-2], ("DITR stage one", found[-2][1]), ("DITR stage two", found[-1][1])]
    found = [(SPELLING.get(method, method), numbers) for method, numbers in found]
    assert found == list(tables.TABLES[name].rows.items())


@needs_source
def test_dataset_sizes_are_the_paper_s():
    text = SOURCE.read_text(encoding="utf-8")
    sizes = re.search(r"These datasets have (\d+), (\d+), and (\d+) RGBD image sets respectively", text).groups()
    assert [int(n) for n in sizes] == [tables.SIZES[name] for name in ("ClearGrasp", "TODD", "STD")]
    assert "30 scenes with 900 samples each" in text and tables.SIZES["STD"] == 30 * 900


def test_the_reader_of_the_source_notices_a_changed_number():
    source = (
        r"\begin{table}\begin{tabular}{l|c}\hline ~& RMSE\\ \hline A\cite{a}& 0.1\\ B& \textbf{0.25} \\ \hline"
        r"\end{tabular}\label{tab:x}\end{table}"
    )
    assert printed(source, "x") == [("A", (0.1,)), ("B", (0.25,))]


@pytest.mark.parametrize("table", tables.TABLES.values(), ids=lambda t: t.name)
def test_tables_are_rectangular_and_in_their_units(table):
    assert all(len(row) == len(table.columns) for row in table.rows.values())
    for row in table.records().values():
        for column, value in row.items():
            metric = column.split(".")[-1]
            assert (0 < value < 1) if metric in METRICS[:3] else (0 < value <= 100 or metric not in METRICS)


def test_the_full_system_is_the_same_in_tables_1_and_4():
    assert tables.T4.rows["BB + DP + RR"] == tables.T1.rows["DITR"]
    assert set(tables.T5.rows) < set(tables.T1.rows)


def test_reordering_moves_numbers_not_names():
    swapped = tables.T5.reordered(("rmse", "rel", "mae")).records()["DITR"]
    assert swapped["geometric.rel"] == 0.018 and swapped["optical.mae"] == 0.015 and swapped["geometric.rmse"] == 0.013
    assert tables.T5.reordered(METRICS[:3]) == tables.T5
    for bad in (("rmse", "mae"), ("rmse", "mae", "mae")):
        with pytest.raises(ValueError, match="each once"):
            tables.T5.reordered(bad)
    with pytest.raises(ValueError, match="no parts"):
        tables.T1.reordered(METRICS[:3])
