# Each target calls one command; what it does is in that command. `make help` lists them.
# PYTHON is the interpreter from which the environment is built (3.11 or newer), VENV where it goes.

PYTHON ?= python3
VENV ?= .venv
PY := $(VENV)/bin/python
STAMP := $(VENV)/.installed-$(shell cat environment.txt pyproject.toml | cksum | cut -d' ' -f1)
NBVAL := --nbval-lax --nbval-current-env --nbval-cell-timeout=120 --nbval-sanitize-with=tests/nbval_sanitize.cfg
EXECUTE := -m nbconvert --execute --ExecutePreprocessor.record_timing=False --ExecutePreprocessor.timeout=600
NEWS := @jupyterlab/apputils-extension:announcements # would ask the network, and the reader first
LIMIT ?= 16

export OMP_NUM_THREADS ?= 2
unexport MPLBACKEND # notebooks draw inline, everything else finds out that there is no display

.DEFAULT_GOAL := help
.PHONY: help lab demo test mutants lint notebooks students book samples train bench clean

help: ## list the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 12

# A new stamp for every content of the two files; an environment that is already there is brought up to date in place.
$(STAMP):
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11) and 'Python 3.11 or newer is needed: make PYTHON=python3.12')"
	$(PYTHON) -m venv $(VENV)
	$(PY) -m pip install --quiet -r environment.txt
	rm -f $(VENV)/.installed-*
	touch $@

lab: $(STAMP) ## open the notebooks in JupyterLab
	$(PY) -m jupyterlab.labextensions disable --level=sys_prefix $(NEWS) 2>/dev/null
	$(PY) -m jupyterlab --notebook-dir=. notebooks/00_start_here.ipynb

demo: $(STAMP) ## run the whole pipeline notebook, then print the score table of the first LIMIT test scenes
	$(PY) $(EXECUTE) --to html --template classic --output-dir outputs notebooks/06_full_pipeline.ipynb
	$(PY) -m ditr_lite bench --split test --limit $(LIMIT) --json outputs/demo.json

test: lint ## lint, unit tests, every notebook cell by cell
	TQDM_DISABLE=1 $(PY) -m pytest $(NBVAL)

mutants: $(STAMP) ## plant a mistake in every formula, one at a time: a test must notice (many minutes)
	$(PY) tests/mutants.py $(ARGS)

lint: $(STAMP) ## ruff's rules and formatter, notebooks included
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

notebooks: $(STAMP) ## execute all notebooks in place, in order
	TQDM_DISABLE=1 $(PY) $(EXECUTE) --to notebook --inplace $(sort $(wildcard notebooks/*.ipynb))

students: $(STAMP) ## copies of the notebooks without the solutions, in outputs/student
	$(PY) tools/student_copy.py

book: $(STAMP) ## all notebooks as web pages, in outputs/book
	$(PY) tools/book.py

samples: $(STAMP) ## render the shipped scenes again, into outputs/samples
	$(PY) -m ditr_lite simulate --out outputs/samples $(ARGS)

train: $(STAMP) ## train every part from the rendered scenes, into outputs/weights/lite; elsewhere with ARGS="--out FOLDER"
	$(PY) -m ditr_lite train --part all $(ARGS)

bench: $(STAMP) ## score the shipped weights and every baseline on the whole test split
	$(PY) -m ditr_lite bench --split test --json outputs/bench.json $(ARGS)

clean: ## remove what is quickly made again; rendered scenes, training, copies for students and the environment stay
	rm -rf outputs/book outputs/*.html outputs/*.json .pytest_cache .ruff_cache .hypothesis
