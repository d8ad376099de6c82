# Each target calls tasks.py, where it is written what it does; `make help` lists them. Without make: python tasks.py TARGET.
# PYTHON is the interpreter from which the environment is built (3.11 or newer), VENV where it goes, ARGS is passed on.

PYTHON ?= python3
TARGETS := setup class lab demo test mutants lint notebooks students slides timings book offline-kit samples train bench soak clean

export VENV LIMIT

.DEFAULT_GOAL := help
.PHONY: help grade $(TARGETS)

help $(TARGETS):
	@$(PYTHON) tasks.py $@ $(ARGS)

grade: # FOLDER holds what was handed in
	@$(PYTHON) tasks.py grade $(if $(FOLDER),"$(FOLDER)") $(ARGS)
