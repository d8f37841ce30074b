# make test | kills | slurm-test | fuzz | benchmark | lint | wheel | wheel-test | docs | gallery | clean. Each makes .venv and installs what is missing; PYTHON=... chooses the interpreter.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.PHONY: help runtime venv benchmark test test-all kills slurm-test fuzz lint wheel wheel-test docs gallery clean

PYTHON ?=
CANDIDATES := python3.12 python3.11 python3 python
BIN := .venv/bin
STAMP := .venv/installed
INSTALL := $(BIN)/python -m pip install --quiet --no-compile -c constraints.txt

# What the caller's shell may hold that would send an installation elsewhere or let foreign packages in.
# Where packages come from (index, links, proxy, certificates, cache) stays the caller's business.
unexport VIRTUAL_ENV CONDA_PREFIX PYTHONHOME PYTHONPATH PYTHONSTARTUP
unexport PIP_TARGET PIP_PREFIX PIP_ROOT PIP_PYTHON PIP_CONSTRAINT PIP_BUILD_CONSTRAINT PIP_REQUIREMENT PIP_EDITABLE PIP_NO_DEPS
# Python keeps its byte code: without it every process compiles what it imports, and pytest its assertions, anew.
unexport PYTHONDONTWRITEBYTECODE
unexport PIP_DRY_RUN PIP_REQUIRE_HASHES PIP_NO_BUILD_ISOLATION PIP_IGNORE_REQUIRES_PYTHON PIP_REPORT PIP_DEPENDENCY_GROUP
export PIP_USER := 0
export PIP_PROGRESS_BAR := off
export PIP_NO_INPUT := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1

help:
	@echo 'make test        run the tests'
	@echo 'make kills       kill every command at random moments and compare what is left, into out/kills (an hour or two)'
	@echo 'make slurm-test  run a study on a SLURM that is set up for it on this machine (Debian, root)'
	@echo 'make fuzz        thousands of wrong inputs; half an hour or more'
	@echo 'make test-all    run the slow tests, too'
	@echo 'make benchmark   run every supervisor and controller on the case study, into out/paper'
	@echo 'make lint        ruff and mypy'
	@echo 'make wheel       sdist and wheel, checked, into dist'
	@echo 'make wheel-test  install the wheel into new environments and run it there'
	@echo 'make docs        the documentation, into out/docs'
	@echo 'make gallery     draw the pictures in docs/gallery anew'
	@echo 'make clean       remove .venv, builds and caches; results in out and runs stay'

benchmark: runtime
	@$(BIN)/marlbc bench paper --out out/paper --overwrite

test: venv
	@$(BIN)/python tests/warm_cache.py
	@$(BIN)/python -m pytest -n auto --dist worksteal

kills: venv
	@$(BIN)/python tests/kills.py --kills 50 --out out/kills
	@$(BIN)/python tests/kills.py --kills 25 --out out/kills --engine ray --commands suite digests

slurm-test: venv
	@PYTHON=$(BIN)/python bash tests/slurm_test.sh

fuzz: venv
	@$(BIN)/python tests/warm_cache.py
	@$(BIN)/python tests/fuzz --out out/fuzz

test-all: venv
	@$(BIN)/python tests/warm_cache.py
	@$(BIN)/python -m pytest -n auto --dist worksteal --slow

lint: venv
	@status=0; \
	$(BIN)/ruff check --quiet --output-format concise . || status=1; \
	$(BIN)/ruff format --quiet --check --output-format concise . || status=1; \
	$(BIN)/python -m mypy || status=1; \
	exit $$status

# As with docs, the tool that checks is installed here and not with the rest.
wheel: venv
	@rm -rf build dist
	@$(BIN)/python -m build --no-isolation --outdir dist . >/dev/null
	@$(BIN)/python -c 'import twine' 2>/dev/null || $(INSTALL) -e '.[release]'
	@$(BIN)/python -m twine check --strict dist/*
	@$(BIN)/python tests/wheel.py dist

# The wheel in two new environments: as it is, and with what users may add to it.
wheel-test: wheel
	@$(BIN)/python tests/wheel.py dist --install out/wheel
	@$(BIN)/python tests/wheel.py dist --install out/wheel --extras onnx parquet robots

# The tool is installed here and not with the rest: only this target needs it. With --quiet mkdocs would count no warnings,
# and --strict would refuse nothing.
docs: venv
	@$(BIN)/python -c 'import mkdocs, material, mkdocstrings_handlers.python' 2>/dev/null || \
		$(INSTALL) -e '.[docs]'
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --site-dir out/docs
	@echo out/docs/index.html

gallery: runtime
	@MUJOCO_GL=$${MUJOCO_GL:-egl} $(BIN)/python docs/make_gallery.py

clean:
	@rm -rf .venv .cache build dist ./*.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	@find marlbc_mj tasks training tests -name __pycache__ -type d -prune -exec rm -rf {} +

# A candidate counts only if it runs (version managers leave stubs that do not), has the right version and can make an environment.
define FIND_PYTHON
for candidate in $(if $(PYTHON),'$(PYTHON)',$(CANDIDATES)); do \
	if "$$candidate" -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 13))' 2>/dev/null; \
	then python=$$candidate; break; fi; \
done
endef

# The package, with what its robots need. Installed again when the two files below change, made anew when the folder has moved
# or the Python is gone. The lock is for two makes at once.
runtime:
	@mkdir -p .cache; exec 9>.cache/venv.lock; if command -v flock >/dev/null; then flock 9; fi; \
	wanted="$$(cat pyproject.toml constraints.txt | cksum) $$PWD"; \
	found=$$(cat $(STAMP) 2>/dev/null || :); \
	if ! $(BIN)/python -c '' 2>/dev/null; then found=; fi; \
	if [ "$$found" = "$$wanted" ]; then exit 0; fi; \
	case "$$found" in *" $$PWD") ;; *) \
		python=; $(FIND_PYTHON); \
		if [ -z "$$python" ]; then echo "make: none of $(or $(PYTHON),$(CANDIDATES)) runs as Python 3.11 or 3.12 with venv and ensurepip; \
	install one (Debian: python3 and python3-venv) or name it: make PYTHON=..." >&2; exit 1; fi; \
		rm -rf .venv; "$$python" -m venv .venv;; \
	esac; \
	echo "installing into .venv with $$($(BIN)/python --version), a minute or more"; \
	rm -f $(STAMP)*; $(INSTALL) -e '.[robots]'; \
	echo "$$wanted" > $(STAMP)

# What the tests and the linters need beside it. The package itself stays as it is, so that it can run meanwhile.
venv: runtime
	@exec 9>.cache/venv.lock; if command -v flock >/dev/null; then flock 9; fi; \
	if cmp -s $(STAMP) $(STAMP)-dev; then exit 0; fi; \
	echo 'installing what the tests need into .venv, half a minute or more'; \
	$(BIN)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["dev"], sep="\n")' \
		> .cache/dev.txt; \
	$(INSTALL) -r .cache/dev.txt; \
	cp $(STAMP) $(STAMP)-dev
