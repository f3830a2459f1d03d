# qs3: make quickstart, make test. `make help` lists the rest.
PYTHON ?= python3
VENV   ?= .venv
RUN    := $(VENV)/bin/python
# The tested versions; of 3.12 as of 3.13.
PINS   := constraints/$(shell $(PYTHON) -c 'import sys; print("3.11" if sys.version_info < (3, 12) else "3.13")').txt
EXTRAS ?= dev
# Of `make test-python`.
PY     ?= python3.13
OUT    ?= out/quickstart
# Extra arguments for pip, e.g. an index that has CPU builds of torch.
PIP_ARGS ?=
# Of pytest; a file's tests run in one process, in order.
PARALLEL ?= -n 2 --dist loadfile
# Of `make bench`.
DEVICE ?= cpu
THREADS ?=
POINTS ?=

.DEFAULT_GOAL := help
.PHONY: help install doctor quickstart lint format test test-all test-python test-triton bench docs clean

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 20

install: $(VENV)/installed ## the environment in .venv, pinned

$(VENV)/installed: pyproject.toml $(PINS)
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install --disable-pip-version-check --quiet $(PIP_ARGS) -c $(PINS) -e '.[$(EXTRAS)]'
	@touch $@
	@$(RUN) -m qs3 doctor

doctor: install ## what works here, and which system package would help
	@$(RUN) -m qs3 doctor

quickstart: install ## the main job on embedded data, about six minutes on 2 idle cores
	@$(RUN) -m qs3 quickstart out=$(OUT)

lint: install ## style, types and who may import whom; changes nothing
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports

format: install ## tidy the files
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

# The tests start many processes; where Python is told to keep no bytecode, each of them and each
# worker would compile all modules again.
test test-all: export PYTHONDONTWRITEBYTECODE =

test: install ## all tests that are not slow, on 2 cores
	$(RUN) -m pytest $(PARALLEL) --ignore=tests/benchmarks

test-python: ## another Python, PY=python3.13, in an environment of its own: install, scan, train, predict
	rm -rf out/venv-$(notdir $(PY))
	$(MAKE) install PYTHON=$(PY) VENV=out/venv-$(notdir $(PY)) EXTRAS=blender
	.ci/smoke out/venv-$(notdir $(PY))/bin
	rm -rf out/venv-$(notdir $(PY))

test-triton: install ## kernels for GPUs in Triton's interpreter, which is fetched for it (286 MB)
	$(RUN) -m pip install --disable-pip-version-check --quiet $(PIP_ARGS) --no-deps --target out/triton triton==3.9.0
	PYTHONPATH=out/triton $(RUN) -m pytest $(PARALLEL) tests/kernels/test_points.py \
	  tests/kernels/test_edge_norm.py tests/kernels/test_linear_max.py

test-all: install ## the slow tests too, shapes in signatures checked, and the benchmarks once each
	QS3_CHECK_SHAPES=1 $(RUN) -m pytest $(PARALLEL) -m ''

bench: install ## speed, as ratios against named baselines; of nets and methods on DEVICE=cuda; THREADS=1; POINTS=512 in methods' clouds
	QS3_BENCH_DEVICE=$(DEVICE) QS3_BENCH_THREADS=$(THREADS) QS3_BENCH_POINTS=$(POINTS) $(RUN) -m pytest tests/benchmarks --benchmark-enable -s

docs: install ## the docs as a site, in out/site
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict -f .ci/mkdocs.yml
	@echo "open out/site/index.html"

clean: ## remove what `make quickstart` made
	rm -rf out
