# `make` lists the targets. Needs GNU make, a POSIX shell and Python >= 3.10; everything else goes into .venv.

PYTHON ?=
WHEEL_INDEX ?=
ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PIP := $(BIN)/python -m pip install --disable-pip-version-check --quiet

.PHONY: help install demo test bless check bench chaos screenshots images clean FORCE
.DELETE_ON_ERROR:

help: ## list the targets
	@echo 'make TARGET [PYTHON=python3.11] [WHEEL_INDEX=URL] [ARGS="..."]'
	@sed -n 's/^\([a-z]*\):[^#]*## /  \1	/p' $(firstword $(MAKEFILE_LIST)) | expand -t 16
	@echo 'PyTorch without gigabytes of CUDA: WHEEL_INDEX is the URL of its index of CPU wheels (see pytorch.org)'

install: $(STAMP) ## create .venv with all packages; does nothing if it is up to date

# The stamp is written last, so that an interrupted installation is repeated.
$(STAMP): pyproject.toml constraints.txt
	@rm -f $@
	@$(find_venv)
	$(PIP) --upgrade 'pip>=24'
	$(PIP) $(if $(WHEEL_INDEX),--extra-index-url '$(WHEEL_INDEX)') -c constraints.txt -e '.[dev]'
	@touch $@

# Installs again if PYTHON names another version than the one in .venv, although the stamp is up to date.
ifneq ($(PYTHON),)
ifneq ($(shell $(BIN)/python --version 2>&1),$(shell '$(PYTHON)' --version 2>&1))
$(STAMP): FORCE
endif
endif

# A Python on the path may be a stub that fails (pyenv) or lack venv (Debian), so each is run before it is used.
# PyBullet has wheels for 3.10 and 3.11 only, so these are tried first.
define find_venv
if $(BIN)/python -m pip --version >/dev/null 2>&1 \
  && { test -z '$(PYTHON)' || test "$$($(BIN)/python --version)" = "$$('$(PYTHON)' --version 2>&1)"; }; then exit 0; fi; \
if test -n '$(PYTHON)'; then names='$(PYTHON)'; else names='python3.11 python3.10 python3 python3.12 python3.13 python'; fi; \
for name in $$names; do \
  $$name -c 'import sys; sys.exit(sys.version_info < (3, 10))' >/dev/null 2>&1 || continue; \
  $$name -c 'import sys; sys.exit(sys.version_info >= (3, 12))' \
    || echo "make: PyBullet has no wheel for this Python and is compiled: minutes, and it needs a C++ compiler"; \
  echo "make: $(VENV) from $$name ($$($$name --version 2>&1))"; \
  rm -rf $(VENV); \
  if $$name -m venv $(VENV); then exit 0; fi; \
  rm -rf $(VENV); \
  echo "make: $$name cannot make a virtual environment; on Debian and Ubuntu: apt-get install $${name##*/}-venv"; \
done; \
echo "make: no working Python >= 3.10 among: $$names." >&2; \
echo "make: install Python 3.11 (Debian: apt-get install python3.11 python3.11-venv) or name one: make install PYTHON=/path/to/python3.11" >&2; \
exit 1
endef

demo: install ## localise and drive in the corridor: every service, a live page, a recording, a picture
	$(BIN)/presage demo --open $(ARGS)

test: install ## all tests
	@# Hundreds of processes are started: with PYTHONDONTWRITEBYTECODE set, each would compile all modules again.
	@$(BIN)/python -m compileall -q common services presage lab worlds models tests
	@# Three workers keep two cores busy, because tests of processes mostly wait. More than one thread each would slow the others.
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder $(ARGS)

bless: install ## show how the outputs of services differ from the stored references, and accept them
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.process_replay.bless $(ARGS)

check: install ## style, format and types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

bench: install ## measure the latency from scan to command and zenoh's own round trip
	$(BIN)/presage bench latency $(ARGS)

chaos: install ## inject faults into a system on three hosts; measure detection, stop and recovery
	$(BIN)/presage bench chaos $(ARGS)

screenshots: install ## docs/page.png and docs/page.webp of the live page; needs Chromium
	$(BIN)/python -m tests.viewer.screenshots $(ARGS)

images: ## build all container images, and print how much each adds to its base, python:3.11-slim
	docker compose build $(if $(WHEEL_INDEX),--build-arg WHEEL_INDEX='$(WHEEL_INDEX)')
	for scanner in replay none bridge_ros2; do PRESAGE_SCANNER=$$scanner docker compose build simulator || exit 1; done
	@base=$$(docker image inspect --format '{{.Size}}' python:3.11-slim); \
	for name in router none bridge_ros2 recorder replay controller simulator viewer cli estimator; do \
	  size=$$(docker image inspect --format '{{.Size}}' presage-$$name) || exit 1; \
	  echo "presage-$$name: $$(( ($$size - $$base) / 1000000 )) MB"; \
	done

clean: ## remove .venv and caches; recordings are kept
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis build dist
	find common services presage lab tests -name __pycache__ -type d -prune -exec rm -rf {} +
