# `make demo` and `make test` need Python 3.11-3.13 with venv, and nothing else.
PYTHON ?= python3
VENV ?= .venv
# For example `-c requirements.lock`, the exact versions that CI runs with (Python 3.11).
INSTALL_FLAGS ?=
DATA := $(or $(SIGMASLAM_DATA),$(wildcard ../shared/data))

.PHONY: demo test test-slow lint clean

demo: $(VENV)/.runtime
	$(VENV)/bin/sigmaslam demo

# One process a core, one thread each.
test: $(VENV)/.dev
	OMP_NUM_THREADS=1 SIGMASLAM_DATA="$(DATA)" $(VENV)/bin/python -m pytest --numprocesses auto --dist loadscope

test-slow: $(VENV)/.dev
	SIGMASLAM_DATA="$(DATA)" $(VENV)/bin/python -m pytest -m slow

lint: $(VENV)/.dev
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

clean:
	rm -rf $(VENV) build dist *.egg-info

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

# The runtime alone: no torch.
$(VENV)/.runtime: pyproject.toml | $(VENV)/bin/python
	$(VENV)/bin/python -m pip install --quiet $(INSTALL_FLAGS) --editable .
	touch $@

$(VENV)/.dev: pyproject.toml | $(VENV)/bin/python
	$(VENV)/bin/python -m pip install --quiet $(INSTALL_FLAGS) --editable ".[dev]"
	touch $@ $(VENV)/.runtime
