# make demo, make test: each does all set-up on a machine with Python >= 3.11, git and a C compiler.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin

.PHONY: demo test test-long lint format docs bench figures system-deps clean

# Core alone: what training needs, no simulator.
$(VENV)/.core: pyproject.toml constraints.txt scripts/install.sh
	PYTHON="$(PYTHON)" sh scripts/install.sh "$(VENV)" .
	@touch $@

$(VENV)/.dev: $(VENV)/.core
	PYTHON="$(PYTHON)" sh scripts/install.sh "$(VENV)" ".[dev,wandb,joblib,slurm,mujoco,metaworld,maniskill,plasticine]"
	@touch $@

$(VENV)/.docs: $(VENV)/.core
	PYTHON="$(PYTHON)" sh scripts/install.sh "$(VENV)" ".[docs]"
	@touch $@

# OSMesa and a Vulkan device: what drawing without a screen needs on Debian and Ubuntu.
system-deps:
	sh scripts/system_deps.sh

demo: $(VENV)/.core
	$(BIN)/python scripts/demo.py

test: $(VENV)/.dev lint
	$(BIN)/python -m pytest

test-long: $(VENV)/.dev
	$(BIN)/python -m pytest -m long --timeout=0

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# Redraws from results/ every figure that has some, and the page of results.
figures: $(VENV)/.core
	$(BIN)/python scripts/figure_bandit.py --redraw
	$(BIN)/python scripts/figures.py all draw
	$(BIN)/python scripts/results_table.py

bench: $(VENV)/.core
	$(BIN)/python benchmarks/learning.py --against eager --out benchmarks/output
	$(BIN)/python benchmarks/replay.py --out benchmarks/output
	$(BIN)/python benchmarks/act.py --out benchmarks/output
	$(BIN)/python benchmarks/table.py

clean:
	rm -rf $(VENV) runs multirun site build *.egg-info
