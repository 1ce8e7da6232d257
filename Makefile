# `make demo` works on a bare machine with Python 3.11 or newer; nothing has to be prepared.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Pinned, and installed before anything that depends on it: pip would otherwise be free to pick another build of torch.
# On Linux the one on PyPI brings CUDA (gigabytes). PyTorch's own index has 2.13.0+cpu, which pip prefers as the later
# version; it is asked first whether it answers, as pip would try it five times for every package. TORCH_INDEX= leaves it out.
TORCH ?= torch==2.13.0
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
TORCH_ARGS ?=
ANSWERS := from sys import argv; from urllib.request import urlopen; urlopen(argv[1] + "/torch/", timeout=9)
# bytecode is made of what is imported when it is imported: of all the packages it would be 0.27 GB more
PIP := $(BIN)/python -m pip --disable-pip-version-check
INSTALL := $(PIP) install --no-compile
# files of tests are spread over the cores, long ones first (tests/conftest.py); a file's tests stay together, as they
# share what they prepare
TEST_ARGS ?= --numprocesses logical --maxprocesses 4 --dist loadfile --no-loadscope-reorder

.DEFAULT_GOAL := help
QGIS_PROFILE ?= $(HOME)/.local/share/QGIS/QGIS3/profiles/default
.PHONY: help demo install dev test lint format docs qgis-zip qgis-install clean

help: ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

demo: install ## simulate a city, reconstruct it, score it; results in ./demo
	bash examples/quickstart.sh demo

install: $(VENV)/.installed $(VENV)/.tried ## make .venv and install sattools into it

dev: $(VENV)/.installed-dev $(VENV)/.tried ## the same with the tools for tests

# where the environment keeps no bytecode, every process that the tests start would compile again what it imports
test: lint ## check style and types, then run the tests
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest $(TEST_ARGS)

lint: dev ## check style, types and spelling
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/codespell

format: dev ## put the code into the project's format
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

docs: dev $(VENV)/.installed-docs ## write docs/commands.md from the commands' help, and build the site in build/site; warnings are errors
	$(BIN)/python docs/generate_commands.py
	$(BIN)/mkdocs build --strict --quiet

qgis-zip: ## pack the QGIS plugin for "install from zip"
	rm -f dist/sattools_qgis.zip && mkdir -p dist
	find qgis_plugin -name __pycache__ -type d -prune -exec rm -rf {} +  # plugins.qgis.org refuses a zip with one
	cd qgis_plugin && $(PYTHON) -m zipfile -c ../dist/sattools_qgis.zip sattools_qgis

qgis-install: ## copy the QGIS plugin into the profile (QGIS_PROFILE), from where QGIS loads it
	mkdir -p "$(QGIS_PROFILE)/python/plugins"
	rm -rf "$(QGIS_PROFILE)/python/plugins/sattools_qgis"
	cp -r qgis_plugin/sattools_qgis "$(QGIS_PROFILE)/python/plugins/"

clean: ## remove .venv, caches and the demo
	rm -rf $(VENV) demo build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamps are younger than pyproject.toml as long as nothing has to be installed again.
$(VENV)/.torch:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "sattools needs Python 3.11 or newer")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@index="$(TORCH_INDEX)"; if [ -n "$$index" ] && ! $(BIN)/python -c '$(ANSWERS)' "$$index" 2>/dev/null; then \
		echo "$$index does not answer: PyTorch comes from where pip looks otherwise" >&2; index=; fi; \
		$(INSTALL) $${index:+--extra-index-url "$$index"} $(TORCH_ARGS) "$(TORCH)"
	touch $@

$(VENV)/.installed: pyproject.toml $(VENV)/.torch
	$(INSTALL) -e .
	$(BIN)/sattools doctor --slim
	touch $@

$(VENV)/.installed-dev: pyproject.toml $(VENV)/.torch
	$(INSTALL) -e ".[dev]"
	touch $@ $(VENV)/.installed

$(VENV)/.installed-docs: $(VENV)/.installed-dev
	$(INSTALL) -q --only-binary :all: -e ".[docs]"
	touch $@

# a small scene through every step: it works, and kernels are compiled now and not by the first run
$(VENV)/.tried: | $(VENV)/.installed
	PYTHONDONTWRITEBYTECODE= $(BIN)/sattools doctor --try
	touch $@
