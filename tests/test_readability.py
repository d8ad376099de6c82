"""tools/readability.py: what counts as prose, how sentences are told apart, and that the notebooks keep the limit."""

from pathlib import Path

import nbformat
import pytest
import readability
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

ROOT = Path(__file__).resolve().parents[1]
TEXT = """# A heading is no sentence

One two three. Four five `a.b(c)` and $x = 1.5$, by Eq. 3 (e.g. here)! Six?

| a table | is none |
|---|---|
- an item without an end
- another [linked item](06_full_pipeline.ipynb#part)

$$ D = f(x). \\text{ Nor is this.} $$

```sh
nothing. of. this.
```
<details><summary>Short answer</summary>

Hidden words count, too.
</details>
"""


def written(tmp_path, markdown, name="n"):
    path = tmp_path / f"{name}.ipynb"
    cells = [new_markdown_cell(markdown), new_code_cell("this_is_code = 'No. prose. At. all.'")]
    nbformat.write(new_notebook(cells=cells), path)
    return path


def test_only_prose_is_counted():
    found = [" ".join(words) for words in readability.sentences(readability.prose(TEXT))]
    assert found[0] == "One two three."
    assert found[1].startswith("Four five xxxxx and xxxxx, by Eq 3 e.g") and found[2] == "Six"
    assert found[3:] == ["an item without an end", "another linked item", "Short answer", "Hidden words count, too."]


def test_the_figures_are_those_of_a_hand_count():
    row = readability.measure("Cats eat fish. Dogs eat meat every single day.\n\n- Fine.")
    assert (row.sentences, row.median) == (3, 3)
    letters = len("CatseatfishDogseatmeateverysingledayFine")
    assert row.index == pytest.approx(4.71 * letters / 10 + 0.5 * 10 / 3 - 21.43)


def test_long_sentences_are_named_and_short_ones_pass(tmp_path, capsys):
    short, long = written(tmp_path, "Short one. Another.", "short"), written(tmp_path, "word " * 19 + ".", "long")
    assert readability.main([str(short)]) == 0
    assert readability.main(["--longest", "1", str(short), str(long)]) == 1
    out, err = capsys.readouterr()
    assert "19: word word" in out and "above 18 words in long" in err
    assert readability.main(["--limit", "19", str(long)]) == 0


@pytest.mark.parametrize("markdown", ["", "# Only a heading"])
def test_a_notebook_without_prose_is_refused(tmp_path, capsys, markdown):
    assert readability.main([str(written(tmp_path, markdown))]) == 2
    assert "without a sentence" in capsys.readouterr().err


def test_what_is_no_notebook_is_refused(tmp_path, capsys):
    (tmp_path / "x.ipynb").write_text("{")
    assert readability.main([str(tmp_path / "x.ipynb")]) == 2 and "cannot be read" in capsys.readouterr().err


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda p: p.stem)
def test_the_median_sentence_of_a_notebook_is_short(path):
    assert readability.measure(readability.markdown_of(path)).median <= readability.MEDIAN_LIMIT
