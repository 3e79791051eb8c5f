# `make benchmark` and `make test` are all that a newcomer needs; each makes its own environment in .venv.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
SCENES := data/car-0-small data/turntable-0-small
METHODS := nearest-view tfp+static tfi+4dgs tfp+4dgs spike4dgs spike4dgs-x

# Much starts many processes: Python keeps what it compiles, whatever the shell says.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: benchmark results test check clients docs wheel clean

# The main job: two small scenes, six recipes, table, sheets and leaderboard entries. Killed runs resume.
benchmark: $(STAMP)
	$(BIN)/spike4dgs make-dataset car turntable --profile small --out data
	$(BIN)/spike4dgs run-benchmark $(SCENES) --methods $(METHODS) --out runs/small

# What the published tables show: renders the track `ideal`, measures each cell that has no record, writes the tables.
results: $(STAMP)
	$(BIN)/spike4dgs make-dataset --track ideal --out data/ideal
	$(BIN)/spike4dgs report results --scenes-of data/ideal
	$(BIN)/spike4dgs report results --write

test: $(STAMP)
	$(BIN)/python -m pytest

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# Programs that open our files, each installed into .clients/ by its pins; the table goes to runs/clients/. One or some:
# make clients ONLY='gsply fourdgs'. Not a part of .ci/run: the environments take gigabytes.
clients: $(STAMP)
	PYTHONPATH=tests/support $(BIN)/python tests/clients/run.py $(if $(ONLY),--only $(ONLY))

# The docs site, into site/. The variable silences an announcement of mkdocs-material, which is no warning about the docs.
docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

wheel: $(STAMP)
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .

# Python compiles what it imports, and keeps it; pip would compile all files, most of which nothing here imports.
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[test]'
	touch $@

$(VENV)/.docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	touch $@

clean:
	rm -rf build dist site *.egg-info
