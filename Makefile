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

# What an installation is made of: when one of these changes, it is made again.
BUILD := pyproject.toml setup.py requirements.lock sigmaslam/frontend/kernels.cpp sigmaslam/frontend/kernels.inc

.PHONY: demo test test-slow lint wheel clean

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

# A wheel with compiled kernels, and the demo run from it in an environment of its own.
wheel: $(VENV)/bin/python
	rm -rf dist build
	$(VENV)/bin/python -m pip wheel --quiet --no-deps --wheel-dir dist .
	$(PYTHON) -m venv build/check
	build/check/bin/python -m pip install --quiet $(INSTALL_FLAGS) dist/*.whl
	cd build && check/bin/python -c "import sigmaslam.frontend._kernels"
	cd build && check/bin/sigmaslam demo

clean:
	rm -rf $(VENV) build dist *.egg-info

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

# The runtime alone: no torch.
$(VENV)/.runtime: $(BUILD) | $(VENV)/bin/python
	$(VENV)/bin/python -m pip install --quiet $(INSTALL_FLAGS) --editable .
	touch $@

$(VENV)/.dev: $(BUILD) | $(VENV)/bin/python
	$(VENV)/bin/python -m pip install --quiet $(INSTALL_FLAGS) --editable ".[dev]"
	touch $@ $(VENV)/.runtime
