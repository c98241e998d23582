# Everything a fresh machine needs beside Python and pip is installed into $(VENV).
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
OUT ?= out/demo
JAXVIB = $(BIN)/jaxvib
EXAMPLE = examples/antiphase

.PHONY: demo test test-slow check clean

demo: $(VENV)/installed
	@echo "--- how the first drawing can jam"
	@$(JAXVIB) modes $(EXAMPLE)/machine.toml --out $(OUT)/first
	@echo "--- the supports that leave the foundation at rest"
	@$(JAXVIB) optimize $(EXAMPLE)/design.toml --out $(OUT)/antiphase
	@echo "--- the machine that was found, spun up smoothly from rest"
	@$(JAXVIB) simulate $(OUT)/antiphase/found.toml --until 120s --spin-up 30s --start spin_up --out $(OUT)/spin_up
	@echo "--- pictures"
	@ls $(OUT)/*/*.png

test: $(VENV)/installed
	$(BIN)/python -m pytest -n 2

test-slow: $(VENV)/installed
	$(BIN)/python -m pytest -n 2 -m slow

check: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	@touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --editable '.[test,dev]'
	@touch $@

clean:
	rm -rf $(VENV) out
