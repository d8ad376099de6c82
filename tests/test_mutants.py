"""The list of mutants fits the code; running it takes minutes and is ``make mutants``."""

import ast
from collections import Counter

import pytest
from mutants import MUTANTS, ROOT, Mutant, mutate

FORMULAS = {  # each has its own family of mistakes
    "schedule",
    "the first look",
    "glass that is read as it is",
    "forward (Eq. 7)",
    "conversions (Eq. 9)",
    "loss (Eq. 8)",
    "posterior mean",
    "posterior variance",
    "DDPM step (I1)",
    "DDIM step",
    "quantiser",
    "straight-through",
    "commitment",
    "attention",
    "metrics (Eq. 4-6, I2)",
    "averages and intervals",
    "audit of tables",
    "protocols",
    "partition (Eq. 1-2)",
    "labels and parallax",
    "learning rates (S3)",
    "soft region (S4)",
    "prices of mistakes",
    "depth-aware map (I4)",
    "true outlines",
    "shadows measured",
    "loss types guessed",
    "bounds",
    "readings",
    "windows",
    "encoder",
    "stage two",
    "readings held (detail)",
    "files of any camera",
    "one set of weights",
    "cameras of datasets",
    "stage one in a frame",
    "stage one scored",
    "sensors' noise and dropouts",
    "calibration",
    "a frame's way back",
    "mistakes of a frame",
}


def test_every_mutant_changes_exactly_one_passage_and_is_still_python():
    files = {mutant.file for mutant in MUTANTS}
    sources = {file: (ROOT / "ditr_lite" / f"{file}.py").read_text(encoding="utf-8") for file in files}
    trees = {file: ast.dump(ast.parse(source)) for file, source in sources.items()}
    for mutant in MUTANTS:
        mutated = mutate(sources[mutant.file], mutant)
        assert ast.dump(ast.parse(mutated)) != trees[mutant.file], mutant  # code, not a comment
        assert (ROOT / mutant.tests).is_file(), mutant


def test_every_formula_is_covered_without_repetition():
    assert {m.formula for m in MUTANTS} == FORMULAS
    assert len(MUTANTS) >= 40 and max(Counter((m.file, m.old, m.new) for m in MUTANTS).values()) == 1


@pytest.mark.parametrize("old, new", [("x", "y"), ("absent", "y"), ("z", "z")])
def test_a_passage_that_does_not_fit_is_refused(old, new):
    with pytest.raises(ValueError, match="expected once"):
        mutate("x = x + z\n", Mutant("formula", "mistake", "file", old, new))
