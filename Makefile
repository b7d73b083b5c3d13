# SPDX-License-Identifier: Apache-2.0
# `make` prints help. Every target sets up what it needs: a fresh machine needs Python >= 3.11 and make, no more.

PYTHON ?= python3
UV ?= uv
OUT ?= out
ARGS ?=
EXTRACTS ?= $(SASGEO_EXTRACTS)
VENV := .venv
STAMP := $(VENV)/.installed
DOCS_STAMP := $(VENV)/.docs-installed
DOCS_RUN ?= 1
VENV_PYTHON := $(VENV)/bin/python
PIP := $(VENV_PYTHON) -m pip --disable-pip-version-check
SASGEO := $(VENV)/bin/sasgeo-bench
SOURCES := sasgeo_bench baselines paper benchmarks tests docs

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help install demo head-start list-regions build-region queries leaderboard test test-of test-quick test-torch test-oldest test-wheel check bench ageing figures docs lock wheels-arm clean

help: ## print this list
	@printf 'sasgeo-bench: make TARGET\n\n'
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@printf '\nVariables: REGION=<id> PIPELINE=<id> RESULTS=<folder to store a board in> DATE=<yyyy-mm-dd> OF=<folder or file of tests> N=<sites> SEED=<number> OUT=<folder, default out> ARGS=<more flags> PYTHON=<default python3>\n'

# Rebuilt when the lock or the packages' own metadata change; otherwise nothing runs, so a second call is quick.
$(STAMP): requirements.lock pyproject.toml baselines/pyproject.toml paper/pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "$(PYTHON) is missing or older than 3.11: install Python >= 3.11, or name one: make PYTHON=/path/to/python" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "$(PYTHON) cannot make virtual environments: install its venv module (Debian, Ubuntu: apt install python3-venv)" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet --require-hashes -r requirements.lock
	$(PIP) install --quiet --no-deps --no-build-isolation -e . -e baselines -e paper
	@touch $@

install: $(STAMP) ## set up .venv from requirements.lock (the other targets do it too)

demo: $(STAMP) ## build an embedded town and show what is in it; a small leaderboard and its site
	$(SASGEO) build-region town-riverside --out $(OUT) $(ARGS)
	$(SASGEO) inspect town-riverside --out $(OUT)
	$(SASGEO) leaderboard demo --jobs 2 --out $(OUT)
	$(SASGEO) publish --board $(OUT)/boards/demo

# Answers that take long lie in the archive; the matcher left out is asked each time. A copy of the file has no archive
# beside it. PACK=<path without .toml> packs those of another pipeline file.
PACK ?= pipelines/demo
HEAD_START := $(OUT)/head-start
head-start: $(STAMP) ## pack the answers that come with the demo, pipelines/demo.tar.xz, and state its hash in demo.toml
	rm -rf $(HEAD_START)
	mkdir -p $(HEAD_START)
	cp $(PACK).toml $(HEAD_START)
	$(SASGEO) leaderboard $(HEAD_START)/$(notdir $(PACK)).toml --jobs 2 --no-cases --out $(HEAD_START)
	tar --create --xz --file $(PACK).tar.xz --directory $(HEAD_START) --sort=name --mtime=2025-01-01 --owner=0 --group=0 \
	  --numeric-owner --exclude='.*' --exclude=runs/global_descriptor --exclude=learned runs
	sed -i -e '/^archive = /d' -e "0,/^id = .*/s//&\narchive = {sha256 = \"$$(sha256sum $(PACK).tar.xz | cut -d ' ' -f 1)\"}/" $(PACK).toml

list-regions: $(STAMP) ## list the regions that come with the package
	$(SASGEO) list regions $(ARGS)

build-region: $(STAMP) ## build one region: REGION=vaduz, and DATE=2021-10-28 for another date
	@test -n "$(REGION)" || { echo "name the region: make build-region REGION=vaduz (make list-regions shows all)" >&2; exit 2; }
	$(SASGEO) build-region $(REGION) $(if $(DATE),--date $(DATE)) --out $(OUT) $(ARGS)

queries: $(STAMP) ## draw every suite on the towns, and on each real region whose extract is here: N=8 sites each, SEED=0
	$(SASGEO) make-queries --up-to --skip $(if $(N),--n $(N)) $(if $(SEED),--seed $(SEED)) \
	  $(if $(EXTRACTS),--extracts "$(EXTRACTS)") --out $(OUT) $(ARGS)

leaderboard: $(STAMP) ## carry out the registered experiment, or PIPELINE=demo, or a file; goes on where it was cut off
	$(SASGEO) leaderboard $(or $(PIPELINE),places) --jobs 2 $(if $(EXTRACTS),--extracts "$(EXTRACTS)") \
	  $(if $(RESULTS),--results "$(RESULTS)") --out $(OUT) $(ARGS)

# Three workers for two processors: now and then a test waits for a process that it has started.
# Hundreds of processes import the same modules: none of them compiles them again.
test test-of test-quick test-torch test-oldest test-wheel: export PYTHONDONTWRITEBYTECODE :=
# The workers fill the processors already: threads of linear algebra and of image warps would wait for each other.
test test-of test-quick test-torch test-oldest test-wheel: export OMP_NUM_THREADS := 1
test test-of test-quick test-torch test-oldest test-wheel: export OPENCV_FOR_THREADS_NUM := 1

test: $(STAMP) ## run the tests and every example in the docstrings; says what it skips and why
	$(VENV_PYTHON) -m pytest -n 3 --dist loadfile -p no:benchmark -rs $(ARGS)

# One process: a few tests are over before several have begun.
test-of: $(STAMP) ## run the tests and examples of one folder or file: make test-of OF=osm, or OF=tests/osm/test_sea.py
	@test -n "$(OF)" || { echo "name a folder or a file: make test-of OF=osm, or OF=tests/osm/test_sea.py" >&2; exit 2; }
	$(VENV_PYTHON) -m pytest -p no:benchmark -rs \
	  $(foreach each,$(OF),$(or $(wildcard tests/$(each) sasgeo_bench/$(each)),$(each))) $(ARGS)

test-quick: $(STAMP) ## run, for a first look, the tests that need nothing built for several of them
	$(VENV_PYTHON) -m pytest -n 2 --dist loadfile -p no:benchmark -m "quick and not slow" --hypothesis-profile=quick $(ARGS)

test-torch: $(STAMP) ## install the extra [torch] of both packages and run the tests that need it; a PyTorch in .venv is kept
	$(PIP) install --quiet --no-build-isolation -e '.[torch]' -e 'baselines[torch]'
	$(VENV_PYTHON) -m pytest -n 2 -p no:benchmark -rs $(addprefix tests/baselines/test_,unet.py deep_retrieval.py image_matchers.py orienternet.py) \
	  tests/search/test_torch_search.py tests/tasks/test_torch.py $(ARGS)

test-oldest: ## run the tests of test-quick with the oldest dependencies that pyproject.toml allows, in .venv-oldest (needs uv)
	$(PYTHON) -m venv .venv-oldest
	$(UV) pip compile --quiet --resolution lowest-direct --extra dask --extra logs --extra publish --extra dev pyproject.toml -o .venv-oldest/oldest.txt
	$(UV) pip install --quiet --python .venv-oldest/bin/python -r .venv-oldest/oldest.txt
	$(UV) pip install --quiet --python .venv-oldest/bin/python --no-deps --no-build-isolation -e . -e baselines -e paper
	.venv-oldest/bin/python -m pytest -n 2 --dist loadfile -p no:benchmark -m "quick and not slow" --hypothesis-profile=quick $(ARGS)

# The wheels are built from the unpacked sdist, which then loses the code: the tests can find the installed packages alone.
# Left out are tests of the repository's own files, which the installed packages do not change.
test-wheel: $(STAMP) ## build the sdist and the wheels in dist/, and run the tests of test-quick on the wheels, in .venv-wheel
	rm -rf dist
	$(VENV_PYTHON) -m hatchling build -t sdist -d $(CURDIR)/dist
	mkdir dist/unpacked
	tar -xzf dist/sasgeo_bench-*.tar.gz -C dist/unpacked --strip-components=1
	cd dist/unpacked && $(CURDIR)/$(VENV_PYTHON) -m hatchling build -t wheel -d $(CURDIR)/dist
	cd dist/unpacked/baselines && $(CURDIR)/$(VENV_PYTHON) -m hatchling build -d $(CURDIR)/dist
	cd dist/unpacked/paper && $(CURDIR)/$(VENV_PYTHON) -m hatchling build -d $(CURDIR)/dist
	rm -r dist/unpacked/sasgeo_bench dist/unpacked/baselines/sasgeo_baselines dist/unpacked/paper/sasgeo_paper
	$(PYTHON) -m venv --clear .venv-wheel
	.venv-wheel/bin/python -m pip --disable-pip-version-check install --quiet --require-hashes -r requirements.lock
	.venv-wheel/bin/python -m pip --disable-pip-version-check install --quiet --no-deps dist/*.whl
	.venv-wheel/bin/python -m pip check
	cd dist/unpacked && $(CURDIR)/.venv-wheel/bin/python -m pytest -n 2 --dist loadfile -p no:benchmark -m "quick and not slow" \
	  --hypothesis-profile=quick --ignore=tests/test_repository.py --ignore=tests/test_docs.py --pyargs sasgeo_bench sasgeo_paper tests $(ARGS)

check: $(STAMP) ## ruff and mypy, as CI runs them
	$(VENV_PYTHON) -m ruff check $(SOURCES)
	$(VENV_PYTHON) -m ruff format --check $(SOURCES)
	$(VENV_PYTHON) -m mypy

bench: $(STAMP) ## measure speed and memory (benchmarks/README.md); a report, never a test
	$(VENV_PYTHON) benchmarks/startup.py
	$(VENV_PYTHON) benchmarks/perturb.py
	$(VENV_PYTHON) benchmarks/make_queries.py
	$(VENV_PYTHON) benchmarks/run_matcher.py
	$(VENV_PYTHON) benchmarks/score.py
	$(VENV_PYTHON) benchmarks/integrity.py
	$(VENV_PYTHON) benchmarks/search.py --out $(OUT) $(ARGS)
	$(VENV_PYTHON) benchmarks/build_region.py $(ARGS)

ageing: $(STAMP) ## measure docs/ageing, resuming in $(OUT)/ageing: EXTRACTS=<folder of the dated extracts>, default SASGEO_EXTRACTS
	@test -n "$(EXTRACTS)" || { echo "name the folder of the extracts: make ageing EXTRACTS=~/osm" >&2; exit 2; }
	$(VENV_PYTHON) docs/ageing/measure.py "$(EXTRACTS)" --out "$(OUT)/ageing"

figures: $(STAMP) ## draw docs/figures anew: EXTRACTS=<folder of the dated extracts>, default SASGEO_EXTRACTS
	@test -n "$(EXTRACTS)" || { echo "name the folder of the extracts: make figures EXTRACTS=~/osm" >&2; exit 2; }
	$(SASGEO) build-region vaduz --extracts "$(EXTRACTS)" --out $(OUT)
	$(VENV_PYTHON) docs/figures/shrink.py $(OUT)/regions/vaduz/preview.png docs/figures/region.webp
	$(SASGEO) publish --board docs/results/places --tables-only --into $(OUT)/public
	$(VENV_PYTHON) docs/figures/shrink.py $(OUT)/public/index.html docs/figures/board.webp

$(DOCS_STAMP): $(STAMP) requirements-docs.lock
	$(PIP) install --quiet --require-hashes -r requirements-docs.lock
	@touch $@

docs: $(DOCS_STAMP) ## build the documentation site in OUT/docs, strictly; DOCS_RUN=0 leaves out the notebook's run
	$(VENV_PYTHON) -m pytest -q -p no:benchmark tests/test_docs.py tests/test_repository.py -k "link or document or docs"
	DOCS_RUN=$(DOCS_RUN) NO_MKDOCS_2_WARNING=1 $(VENV_PYTHON) -m mkdocs build --strict --site-dir $(abspath $(OUT))/docs $(ARGS)

lock: ## resolve requirements.lock and requirements-docs.lock anew from pyproject.toml (needs uv: make lock UV=/path/to/uv)
	$(UV) pip compile pyproject.toml --extra dev --extra dask --extra logs --extra publish --universal --python-version 3.11 --generate-hashes --no-config \
	  --no-emit-index-url --no-emit-find-links --no-annotate --custom-compile-command "make lock" \
	  --output-file requirements.lock $(ARGS)
	$(UV) pip compile --group pyproject.toml:docs --constraint requirements.lock --universal --python-version 3.11 --generate-hashes --no-config \
	  --no-emit-index-url --no-emit-find-links --no-annotate --custom-compile-command "make lock" \
	  --output-file requirements-docs.lock $(ARGS)

# Nothing is installed. jsonpath-rw, of the extra [publish], has a wheel on no system: it is Python alone.
wheels-arm: ## check that every package of requirements.lock has a wheel for Linux on aarch64, glibc 2.28 (needs uv)
	for version in 3.11 3.12 3.13; do \
	  $(UV) pip install --quiet --dry-run --no-config --require-hashes --only-binary :all: --no-binary jsonpath-rw \
	    --python-platform aarch64-manylinux_2_28 --python-version $$version --target .venv-arm -r requirements.lock || exit 1; \
	done
	rm -r .venv-arm

clean: ## remove .venv and caches; keeps what was built in $(OUT)
	rm -rf $(VENV) .venv-oldest .venv-wheel .venv-arm .pytest_cache .mypy_cache .ruff_cache .hypothesis .benchmarks dist
	find $(SOURCES) -name __pycache__ -type d -prune -exec rm -rf {} +
