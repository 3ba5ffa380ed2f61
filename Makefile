# `make help` lists the targets. PYTHON may name another interpreter (3.11 or newer).
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# One file of tests is one worker's: its fixtures are made once.
PYTEST := $(BIN)/python -m pytest --numprocesses logical --maxprocesses 4 --dist loadfile --no-loadscope-reorder

.PHONY: help demo quick test slow check format bench pictures app clean

help:  ## list the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

$(STAMP): pyproject.toml packaging/constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet --constraint packaging/constraints.txt torch
	$(BIN)/pip install --quiet --constraint packaging/constraints.txt --editable '.[dev]'
	touch $@

.PHONY: system
system: $(STAMP)
	@$(PYTHON) packaging/system_libraries.py

demo: system  ## install everything and open the bundled scene (without a display: pictures in demo_out/)
	$(BIN)/python packaging/demo.py

quick: check  ## lint, types, and the tests that take no time: the loop while working
	$(PYTEST) -m "not long"

test: system  ## install everything, then lint, type-check and run every test but the slow tier
	$(MAKE) --no-print-directory check
	$(PYTEST)

slow: system  ## the slow tier alone: fuzzing at length, large scenes, accuracy on real ones
	$(PYTEST) --dist worksteal --slow -m slow

check: $(STAMP)  ## ruff (rules and format) and mypy only
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

format: $(STAMP)  ## put every file into ruff's format
	$(BIN)/ruff check --fix --select I
	$(BIN)/ruff format

bench: system  ## speed against error, on this machine
	$(BIN)/langsplat bench raster --out bench_out

pictures: system  ## make the README's pictures again (on a display, or on Xvfb)
	if [ -n "$$DISPLAY" ]; then $(BIN)/python packaging/pictures.py; \
	else xvfb-run -a -s "-screen 0 1280x800x24" $(BIN)/python packaging/pictures.py; fi

app: system  ## open the viewer
	$(BIN)/langsplat-viewer

clean:  ## remove what these targets made
	rm -rf $(VENV) demo_out bench_out .pytest_cache .mypy_cache .ruff_cache
