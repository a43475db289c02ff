# `make demo` and `make test` need Python 3.11-3.13 with venv, and nothing else.
PYTHON ?= python3
VENV ?= .venv
# The exact versions that CI runs with; empty: the newest ones that pyproject.toml allows.
INSTALL_FLAGS ?= --constraint requirements.lock
# Interpreters that `make dist` compiles kernels for, e.g. PYTHONS="python3.11 python3.12 python3.13".
PYTHONS ?= $(PYTHON)
# Tests on real data read SIGMASLAM_DATA; where it is not set, the folder beside the checkout, if it is there.
ifeq ($(SIGMASLAM_DATA),)
ifneq ($(wildcard ../shared/data),)
export SIGMASLAM_DATA := $(abspath ../shared/data)
endif
endif

# What an installation is made of: when one of these changes, it is made again.
BUILD := pyproject.toml evaluation/pyproject.toml setup.py requirements.lock \
         $(wildcard sigmaslam/*.hpp sigmaslam/*.inc sigmaslam/*/*.cpp sigmaslam/*/*.inc)

.PHONY: demo test test-long test-slow lint docs results dist publish wheel sbom clean

demo: $(VENV)/.runtime
	$(VENV)/bin/sigmaslam demo

# One process a core, one thread each.
test: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest --numprocesses auto --dist loadscope --durations 20

test-long: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest -m "long and not slow" --numprocesses auto --dist loadscope

test-slow: $(VENV)/.dev
	$(VENV)/bin/python -m pytest -m slow

lint: $(VENV)/.dev
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

# The pages and a reference of the packages as a site: build/site/index.html.
docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict

# Every page that a command makes, or those of PAGES, anew: hours. What lacks data or peers is skipped by name.
results: $(VENV)/.dev
	$(VENV)/bin/python release/remake_pages.py $(PAGES)

# What is handed out, of the last commit: sdist, wheel without kernels, a wheel with kernels for each Python; with
# DIST_FLAGS=--many-linux for x86-64 and aarch64 (manylinux_2_28), compiled by zig whatever the machine.
dist: $(VENV)/bin/python
	rm -rf dist
	$(VENV)/bin/python release/build_dist.py $(DIST_FLAGS) dist $(PYTHONS)

# Build, try, list and hand over to a package index, which asks for its token. CONTRIBUTING.md, "A release", comes first.
publish: DIST_FLAGS := --many-linux
publish: wheel sbom
	$(VENV)/bin/python -m pip install --quiet twine
	$(VENV)/bin/python -m twine check --strict dist/*.whl dist/*.tar.gz
	$(VENV)/bin/python -m twine upload dist/*.whl dist/*.tar.gz

# The demo run from the wheel, in an environment of its own for each Python.
wheel: dist
	set -e; for python in $(PYTHONS); do \
	    rm -rf build/check; $$python -m venv build/check; \
	    build/check/bin/python -m pip install --quiet --no-index --no-deps --find-links dist sigmaslam; \
	    build/check/bin/python -m pip install --quiet $(INSTALL_FLAGS) sigmaslam; \
	    (cd build && check/bin/python -c "import sigmaslam.frontend._kernels, sigmaslam.estimation._estimator, \
	        sigmaslam.reconstruction._depths" \
	        && check/bin/sigmaslam demo); \
	done

# The runtime's packages, and what is compiled into the kernels (pybind11, zig's libc++), with versions and licences as
# CycloneDX JSON: dist/sbom.cdx.json.
sbom: dist
	rm -rf build/sbom build/runtime
	$(PYTHON) -m venv build/sbom
	build/sbom/bin/python -m pip install --quiet --constraint requirements.lock cyclonedx-bom
	$(PYTHON) -m venv --without-pip build/runtime
	build/sbom/bin/python -m pip --python build/runtime install --quiet --no-index --no-deps --find-links dist sigmaslam
	build/sbom/bin/python -m pip --python build/runtime install --quiet $(INSTALL_FLAGS) sigmaslam pybind11 \
	    $(if $(DIST_FLAGS),ziglang)
	SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) build/sbom/bin/cyclonedx-py environment build/runtime \
	    --pyproject pyproject.toml --output-reproducible --output-file dist/sbom.cdx.json
	cd dist && sha256sum sbom.cdx.json >> SHA256SUMS

clean:
	rm -rf $(VENV) build dist *.egg-info

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

# The runtime and its pictures: no torch.
$(VENV)/.runtime: $(BUILD) | $(VENV)/bin/python
	$(VENV)/bin/python -m pip install --quiet $(INSTALL_FLAGS) --editable ".[report]"
	touch $@

$(VENV)/.dev: $(BUILD) | $(VENV)/bin/python
	$(VENV)/bin/python -m pip install --quiet $(INSTALL_FLAGS) --editable ".[dev]" --editable evaluation
	touch $@ $(VENV)/.runtime

# mkdocs reads the sources and imports nothing of them.
$(VENV)/.docs: $(BUILD) | $(VENV)/bin/python
	$(VENV)/bin/python -m pip install --quiet $(INSTALL_FLAGS) --editable ".[docs]"
	touch $@
