# Everything that is needed besides Python and pip is installed into $(VENV).
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
OUT ?= out/demo
JAXVIB = $(BIN)/jaxvib
EXAMPLE = examples/antiphase

.PHONY: demo test test-slow validate test-versions check docs bench-guard clean

demo: $(VENV)/installed-demo
	@echo "--- jam modes of the first drawing"
	@$(JAXVIB) modes $(EXAMPLE)/machine.toml --out $(OUT)/first
	@echo "--- supports with the smallest foundation force"
	@$(JAXVIB) optimize $(EXAMPLE)/design.toml --tolerance stiffness=5% --out $(OUT)/antiphase
	@echo "--- spin-up of the optimized machine from rest"
	@$(JAXVIB) simulate $(OUT)/antiphase/found.toml --until 120s --spin-up 30s --start spin_up --out $(OUT)/spin_up
	@echo "--- figures"
	@ls $(OUT)/*/*.png

test: $(VENV)/installed
	$(BIN)/python -m pytest -n 2 --dist loadfile

test-slow: $(VENV)/installed
	$(BIN)/python -m pytest -n 2 --dist loadfile -m slow --ignore=tests/validation

# All hard cases and all numbers of the papers, and the tables of both in the documentation; errors and times go into a file.
validate: $(VENV)/installed
	PYTHONPATH=tests/helpers $(BIN)/python tests/validation/docs_tables.py
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "slow or not slow" --junitxml=out/validation.xml tests/validation

# The lowest versions that may be installed with the lowest Python, and the newest with the highest one.
LOWEST_PYTHON ?= python3.11
HIGHEST_PYTHON ?= python3.13
VERSION_TESTS = tests/runtime tests/numerics tests/machine tests/equations tests/ode tests/test_results.py \
	tests/steady/jams tests/motion/test_endings.py tests/cli tests/sweeps tests/explore tests/docs/test_commands.py

test-versions:
	$(MAKE) .venv-lowest/installed VENV=.venv-lowest PYTHON=$(LOWEST_PYTHON) PIP_CONSTRAINT=.ci/lowest.txt
	$(MAKE) .venv-highest/installed VENV=.venv-highest PYTHON=$(HIGHEST_PYTHON)
	.venv-lowest/bin/python -m pytest -n 2 --dist loadfile $(VERSION_TESTS)
	.venv-highest/bin/python -m pytest -n 2 --dist loadfile $(VERSION_TESTS)

check: $(VENV)/installed-dev
	! git grep -nE '^(<<<<<<<|>>>>>>>) '
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/python .ci/english.py
	$(BIN)/codespell jaxvib optimize jaxvib_command.py tests benchmarks docs .ci README.md CHANGELOG.md CONTRIBUTING.md

# The documentation as pages that open from the disk; a warning is an error.
docs: $(VENV)/installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo out/site/index.html

# Ratios of times, compared with recorded ratios; fails if a ratio is three times as large.
bench-guard: $(VENV)/installed-bench
	$(BIN)/python benchmarks/guard.py

# The installation of a user, without the packages of the tests.
$(VENV)/installed-demo: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable .
	@touch $@

$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	@touch $@

# Another lowest version is installed too.
.venv-lowest/installed: .ci/lowest.txt

$(VENV)/installed-dev: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --editable '.[test,dev]'
	@touch $@

$(VENV)/installed-docs: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --editable '.[test,docs]'
	@touch $@

$(VENV)/installed-bench: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --editable '.[test,bench]'
	@touch $@

clean:
	rm -rf $(VENV) out
