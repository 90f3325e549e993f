# Everything happens in .venv; only python3 with the venv module is needed to begin with.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
DOCS_READY := .venv/.ready-docs

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup demo paper test stress lint docs links gallery dist clean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-8s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(READY) ## install the package, what it needs, and an LLVM that Dr.Jit can use, into .venv

demo: setup ## render a chest with irrcache and compare it with volpath
	$(BIN)/python -m experiments.demo.run

paper: setup ## compute the paper's figures and tables, 20 minutes; FULL=1: the paper's sizes
	$(BIN)/python -m experiments.paper.run $(if $(FULL),--full)

# Files in their order: by default those of few tests come last, which are the longest ones.
test: setup ## run the tests, two at a time: much of each is Python's
	$(BIN)/python -m pytest -m "not slow" --numprocesses 2 --dist loadfile --no-loadscope-reorder --durations 25

stress: setup ## run the slow tests, try every hazard and fault, 40 minutes; ends with tables of what held
	@status=0; $(BIN)/python -m pytest -m slow || status=1; \
	for part in stability faults; do $(BIN)/python -m experiments.robustness.$$part.run || status=1; done; \
	exit $$status

lint: setup ## check style and format
	$(BIN)/ruff check
	$(BIN)/ruff format --check

# Warnings are errors. Executed notebooks are kept in build/.jupyter_cache and run again when edited.
docs: $(DOCS_READY) ## build the documentation site into build/docs; QUICK=1: without running the notebooks
	$(BIN)/python -m sphinx -W --keep-going -q $(if $(QUICK),-D nb_execution_mode=off) docs build/docs
	@echo "open build/docs/index.html"

links: $(DOCS_READY) ## check the addresses that the documentation links to; needs access to them
	$(BIN)/python -m sphinx -b linkcheck -q -D nb_execution_mode=off docs build/links

gallery: setup ## render the images of the gallery, 3 minutes
	$(BIN)/python -m experiments.docs.gallery

dist: setup ## build the sdist and the wheel into dist
	$(BIN)/python -m build

clean: ## remove .venv and everything that was built
	rm -rf .venv build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/pip:
	@command -v $(PYTHON) > /dev/null || { \
	    echo "$(PYTHON) was not found: install Python 3.10 or newer, or say make PYTHON=..." >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
	    echo "$$($(PYTHON) --version) is too old: say make PYTHON=... with 3.10 or newer" >&2; exit 1; }
	@$(PYTHON) -m venv .venv || { rm -rf .venv; \
	    echo "$(PYTHON) cannot make a virtual environment; on Debian and Ubuntu: apt-get install python3-venv" >&2; exit 1; }

$(READY): pyproject.toml | $(BIN)/pip
	@echo "Installing the package and what it needs into .venv; this takes a minute or two"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[test]"
	$(BIN)/python -m mitsuba_irrcache.machine.install_llvm
	@touch $@

$(DOCS_READY): $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[docs]"
	@touch $@
