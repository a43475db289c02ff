# `make demo` and `make test` need Python 3.11-3.13 with venv, and nothing else.
PYTHON ?= python3
VENV ?= .venv
# The exact versions that CI runs with; empty: the newest ones that pyproject.toml allows.
INSTALL_FLAGS ?= --constraint requirements.lock
# Tests on real data read SIGMASLAM_DATA; where it is not set, the folder beside the checkout, if it is there.
ifeq ($(SIGMASLAM_DATA),)
ifneq ($(wildcard ../shared/data),)
export SIGMASLAM_DATA := $(abspath ../shared/data)
endif
endif

.PHONY: demo test test-slow lint clean

demo: $(VENV)/.runtime
	$(VENV)/bin/sigmaslam demo

# One process a core, one thread each.
test: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest --numprocesses auto --dist loadscope --durations 20

test-slow: $(VENV)/.dev
	$(VENV)/bin/python -m pytest -m slow

lint: $(VENV)/.dev
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

clean:
	rm -rf $(VENV) build dist *.egg-info

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

# The runtime alone: no torch.
$(VENV)/.runtime: pyproject.toml requirements.lock | $(VENV)/bin/python
	$(VENV)/bin/python -m pip install --quiet $(INSTALL_FLAGS) --editable .
	touch $@

$(VENV)/.dev: pyproject.toml requirements.lock | $(VENV)/bin/python
	$(VENV)/bin/python -m pip install --quiet $(INSTALL_FLAGS) --editable ".[dev]"
	touch $@ $(VENV)/.runtime
