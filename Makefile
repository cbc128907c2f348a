# `make` lists the targets. Needs GNU make, a POSIX shell and Python >= 3.10; everything else goes into .venv.

PYTHON ?=
WHEEL_INDEX ?=
TORCH_BACKEND ?= cpu
ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEMO_STAMP := $(VENV)/.installed-demo
# uv chooses PyTorch's index itself; another index is left to pip.
UV ?= $(if $(WHEEL_INDEX),,$(shell command -v uv 2>/dev/null))

.PHONY: help install demo test bless check bench chaos tables screenshots images lock platforms clean FORCE
.DELETE_ON_ERROR:

help: ## list the targets
	@echo 'make TARGET [PYTHON=python3.11] [WHEEL_INDEX=URL] [ARGS="..."]'
	@sed -n 's/^\([a-z]*\):[^#]*## /  \1	/p' $(firstword $(MAKEFILE_LIST)) | expand -t 16
	@echo 'With uv, PyTorch is the CPU build (TORCH_BACKEND=auto: for your GPU). With pip, WHEEL_INDEX is the URL of an'
	@echo 'index of CPU builds (see pytorch.org); without it, pip downloads gigabytes of CUDA on Linux.'

install: $(STAMP) ## create .venv with all packages, including PyTorch and development tools

# Each stamp is written last, so that an interrupted installation is repeated.
$(STAMP): pyproject.toml constraints.txt
	@rm -f $@
	@$(find_venv)
	$(call install,.[dev])
	@touch $(DEMO_STAMP) $@

$(DEMO_STAMP): pyproject.toml constraints.txt
	@rm -f $@
	@$(find_venv)
	$(call install,.)
	@touch $@

define install
$(if $(UV),'$(UV)' pip install --quiet --python $(BIN)/python $(if $(TORCH_BACKEND),--torch-backend $(TORCH_BACKEND)),\
$(BIN)/python -m pip install --disable-pip-version-check --quiet \
$(if $(WHEEL_INDEX),--extra-index-url '$(WHEEL_INDEX)')) -c constraints.txt -e '$(1)'
endef

# Installs again if PYTHON names another version than the one in .venv, although the stamps are up to date.
ifneq ($(PYTHON),)
ifneq ($(shell $(BIN)/python --version 2>&1),$(shell '$(PYTHON)' --version 2>&1))
$(STAMP) $(DEMO_STAMP): FORCE
endif
endif

# A Python on the path may be a stub that fails (pyenv) or lack venv (Debian), so each is run before it is used.
# pybullet has wheels for 3.10 and 3.11 only, so these are tried first.
define find_venv
if $(BIN)/python -m pip --version >/dev/null 2>&1 \
  && { test -z '$(PYTHON)' || test "$$($(BIN)/python --version)" = "$$('$(PYTHON)' --version 2>&1)"; }; then exit 0; fi; \
if test -n '$(PYTHON)'; then names='$(PYTHON)'; else names='python3.11 python3.10 python3 python3.14 python3.13 python3.12 python'; fi; \
for name in $$names; do \
  $$name -c 'import sys; sys.exit(sys.version_info < (3, 10))' >/dev/null 2>&1 || continue; \
  echo "make: $(VENV) from $$name ($$($$name --version 2>&1))"; \
  rm -rf $(VENV); \
  if $(if $(UV),'$(UV)' venv --quiet --seed --python $$name $(VENV),$$name -m venv $(VENV)); then exit 0; fi; \
  rm -rf $(VENV); \
  echo "make: $$name cannot make a virtual environment; on Debian and Ubuntu: apt-get install $${name##*/}-venv"; \
done; \
echo "make: no working Python >= 3.10 among: $$names." >&2; \
echo "make: install Python 3.11 (Debian: apt-get install python3.11 python3.11-venv) or name one: make install PYTHON=/path/to/python3.11" >&2; \
exit 1
endef

demo: $(DEMO_STAMP) ## localise and drive in the corridor: every service, a live page, a recording, a picture
	$(BIN)/presage demo --open $(ARGS)

test: install ## all tests
	@# Four workers keep two cores busy, because tests of processes mostly wait. More than one thread each would slow the others.
	@# Hundreds of processes are started: with PYTHONDONTWRITEBYTECODE set, each would compile all modules again, and each worker
	@# all tests.
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder $(ARGS)

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

# The command of each table also stands beside it. PEERS: a folder as described in docs/peers.md. LOGS: a folder with the logs
# of docs/real_logs.md, fr079.npz and uwb.npz. Without them, those tables stay. Interrupted experiments continue, benchmarks
# begin again. All is written to a folder that git ignores, so that every result names the same unchanged commit.
PEERS ?=
LOGS ?=
RESULTS := experiments/tables
tables: install ## measure the generated tables of README and docs/ at this commit, and fill them (many hours)
	mkdir -p $(RESULTS)
	$(BIN)/presage bench accuracy --estimators all --seed 3211 --seeds 5 --trials 10 --minutes 0.2 --json $(RESULTS)/accuracy.json --figure $(RESULTS)/accuracy.png
	$(BIN)/presage experiment --out $(RESULTS) all
	$(BIN)/presage experiment --seed 3579 --out $(RESULTS) navigation --trials 30
	$(BIN)/presage experiment --seed 3580 --out $(RESULTS) navigation --start unknown --trials 30
	$(BIN)/presage experiment --seed 3578 --out $(RESULTS) navigation --worlds office --people 10 --trials 50
	$(BIN)/presage experiment --seed 3551 --out $(RESULTS) navigation --worlds hall --drives holonomic --max-range 4 --beams 271 --prior odometry --slip 0.05 --limit 60 --trials 50
	$(BIN)/presage experiment --seed 3551 --out $(RESULTS) navigation --worlds hall --drives holonomic --max-range 4 --beams 271 --prior odometry --slip 0.05 --limit 60 --trials 50 --no-epistemic
	$(BIN)/presage experiment --seed 3549 --out $(RESULTS) navigation --worlds twins --start unknown --trials 50
	$(BIN)/presage experiment --seed 3535 --out $(RESULTS) navigation --worlds twins --start unknown --trials 50 --drives holonomic --no-epistemic
	$(BIN)/presage experiment --seed 3500 --out $(RESULTS) docking --trials 64
	$(BIN)/presage experiment --seed 3485 --out $(RESULTS) exploration
	$(BIN)/presage bench mapping-faults --worlds 2 --seed 3583 --seconds 60 --json $(RESULTS)/mapping-faults.json
	$(BIN)/presage bench refinement --worlds 3 --seed 3447 --seconds 300 --out $(RESULTS)/refinement --json $(RESULTS)/refinement.json
	$(BIN)/presage bench visits --worlds 0 --visits 6 --scans 100 --seed 4711 --out $(RESULTS)/visits --json $(RESULTS)/visits-office.json
	$(BIN)/presage bench map --size 2000 --json $(RESULTS)/large-map.json
	$(BIN)/presage bench training --out $(RESULTS)/training --json $(RESULTS)/training.json
	$(BIN)/python -m lab.benchmarks.live_changes --worlds office,3482,3483 --seed 3482 --json $(RESULTS)/live-changes.json
	$(BIN)/python -m lab.benchmarks.live_refinement --worlds office,3447,3448 --seed 3447 --json $(RESULTS)/live-refinement.json
	$(if $(PEERS),OMP_NUM_THREADS=1 $(BIN)/presage experiment --seed 3612 --out $(RESULTS) peers '$(PEERS)' --trials 100)
	$(if $(LOGS),$(BIN)/presage map '$(LOGS)/fr079.npz' --mount 0,0,0 --poses reference --half second --no-learn -o $(RESULTS)/maps/second_half.yaml)
	$(if $(LOGS),$(BIN)/presage experiment --out $(RESULTS) real --log '$(LOGS)/fr079.npz' --mount 0,0,0 --world $(RESULTS)/maps/second_half.yaml --exchange --every 200 --name fr079_exchanged)
	$(if $(LOGS),$(BIN)/presage map '$(LOGS)/fr079.npz' --mount 0,0,0 --poses reference --half first --no-learn -o $(RESULTS)/maps/first_half.yaml)
	$(if $(LOGS),$(BIN)/presage experiment --out $(RESULTS) real --log '$(LOGS)/fr079.npz' --mount 0,0,0 --world $(RESULTS)/maps/first_half.yaml --every 30 --name fr079)
	$(if $(LOGS),$(BIN)/presage map '$(LOGS)/uwb.npz' --mount 0,0,0 --poses reference --half first --no-learn -o $(RESULTS)/maps/uwb_first_half.yaml)
	$(if $(LOGS),$(BIN)/presage experiment --out $(RESULTS) real --log '$(LOGS)/uwb.npz' --mount 0,0,0 --world $(RESULTS)/maps/uwb_first_half.yaml --every 10 --name uwb)
	$(BIN)/presage bench integrity --out $(RESULTS)/integrity --worlds 3 --seed 3571 --model exact --seconds 10 --estimators precise,particle-filter,particle-filter-recovery
	$(BIN)/presage bench integrity --out $(RESULTS)/integrity-kidnapped-similar --worlds 20 --seed 3572 --model exact --seconds 10 --cases kidnapped-similar --estimators precise
	$(BIN)/presage bench integrity --out $(RESULTS)/integrity-long-corridor --worlds 40 --seed 3573 --model exact --seconds 10 --cases long-corridor --estimators precise
	$(BIN)/presage bench integrity --out $(RESULTS)/integrity-wrong-map --worlds 40 --seed 3577 --model exact --seconds 10 --cases wrong-map --estimators precise
	$(BIN)/presage bench integrity --out $(RESULTS)/integrity-noisy-map --worlds 20 --seed 3575 --model exact --seconds 40 --cases noisy-map
	$(BIN)/presage bench integrity --out $(RESULTS)/integrity-moved-50 --worlds 20 --seed 3552 --model exact --cases moved-50 --estimators precise,particle-filter,particle-filter-recovery
	$(BIN)/presage bench integrity --out $(RESULTS)/integrity-moved-100 --worlds 40 --seed 3574 --model exact --seconds 10 --cases moved-100 --estimators precise
	$(BIN)/presage bench integrity --out $(RESULTS)/integrity-single-scan --worlds 40 --seed 3576 --model exact --cases single-scan-moved-50 --estimators precise
	for folder in $(RESULTS)/integrity*/; do cp $$folder/integrity.json docs/experiments/$$(basename $$folder).json || exit 1; done
	cp $(RESULTS)/integrity/integrity.png $(RESULTS)/*.json $(RESULTS)/*.csv $(RESULTS)/*.png $(RESULTS)/*.pdf docs/experiments/
	mv docs/experiments/accuracy.png docs/accuracy.png
	for page in README.md docs/*.md; do $(BIN)/presage experiment --out docs/experiments tables --page $$page || exit 1; done

screenshots: install ## docs/page.png and docs/page.webp of the live page; needs Chromium
	$(BIN)/python -m tests.viewer.screenshots $(ARGS)

images: ## build all container images, and print how much each adds to its base, python:3.11-slim
	docker compose build $(if $(WHEEL_INDEX),--build-arg WHEEL_INDEX='$(WHEEL_INDEX)')
	for scanner in replay none bridge_ros2; do PRESAGE_SCANNER=$$scanner docker compose build simulator || exit 1; done
	PRESAGE_ESTIMATOR=paper docker compose build $(if $(WHEEL_INDEX),--build-arg WHEEL_INDEX='$(WHEEL_INDEX)') estimator
	@base=$$(docker image inspect --format '{{.Size}}' python:3.11-slim); \
	for name in router none bridge_ros2 recorder replay controller simulator viewer cli estimator-precise estimator-paper; do \
	  size=$$(docker image inspect --format '{{.Size}}' $${PRESAGE_IMAGE:-presage}-$$name) || exit 1; \
	  echo "$$name: $$(( ($$size - $$base) / 1000000 )) MB"; \
	done

lock: install ## pin every dependency in constraints.txt, for all platforms; ARGS=--upgrade takes newer versions
	$(BIN)/uv pip compile --quiet --universal --all-extras --python-version 3.10 --no-annotate \
	  --custom-compile-command 'make lock' -o constraints.txt pyproject.toml $(ARGS)

platforms: install ## check types for Windows, and that all dependencies have wheels everywhere; print download sizes
	$(BIN)/mypy --platform win32 --follow-imports silent -p common -p services -p presage
	$(BIN)/python -m tests.platforms

clean: ## remove .venv and caches; recordings are kept
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis build dist
	find common services presage lab tests -name __pycache__ -type d -prune -exec rm -rf {} +
