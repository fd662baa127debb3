# Everything runs from here. Each target does its own set-up: Python 3.11 is all that a machine needs.
PYTHON ?= python3.11
BIN := .venv/bin
PRODUCT := hal drivers simbackend perception fusion manipulation service
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
unexport PYTHONDONTWRITEBYTECODE  # where it is set, every process compiles all that it imports, about three seconds

# uv fetches packages side by side and refuses files whose hash is not in hashes.txt. It does not read pip's configuration: where
# it finds nothing, pip does the same without hashes. Both say nothing while they fetch, so a line every five seconds does.
define install
( while sleep 5; do echo "setup: fetching packages"; done ) & ticker=$$!; trap 'kill $$ticker' EXIT; \
$(BIN)/uv pip install --quiet --python $(BIN)/python -c hashes.txt $(1) 2>.venv/uv.log || { \
    if grep -qi 'hash mismatch' .venv/uv.log; then cat .venv/uv.log; echo "error: a package is not the one that hashes.txt names"; exit 2; fi; \
    echo "setup: pip takes over from uv"; $(BIN)/python -m pip install --quiet --no-compile -c constraints.txt $(1); }
endef

.PHONY: docs pictures help setup warm test-packages demo serve test test-wire test-fast test-planted lint lint-style lint-types lint-layers lint-security hashes sbom format bench-cell bench-missions bench-pose bench-fusion bench-range bench-vision bench-cables bench-drivers clean

help:  ## Show this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 16

setup: .venv/ready  ## Make .venv with everything in it

.venv/ready: pyproject.toml constraints.txt hashes.txt
	@command -v $(PYTHON) >/dev/null || { echo "error: $(PYTHON) not found. panelwright needs Python 3.11 (PyBullet has no newer wheels)."; \
	    echo "  try    install python3.11 and python3.11-venv, or give its path: make PYTHON=/path/to/python3.11"; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || { echo "error: $(PYTHON) is $$($(PYTHON) --version 2>&1), not 3.11."; \
	    echo "  try    make PYTHON=/path/to/python3.11"; exit 2; }
	@echo "setup: making .venv (about 120 packages, 2 GB; then the kernels are compiled, once per installation)"
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt uv 2>/dev/null || true
	@$(call install,-e .)
	@$(BIN)/python -c 'import hal, numpy, cv2, pybullet' >/dev/null || { echo "error: the installation is not complete; the lines above say why"; exit 2; }
	@$(MAKE) --no-print-directory -j 2 warm test-packages
	@touch $@
	@echo "setup: ready"

warm:  # kernels are compiled while the packages that only tests need arrive
	@$(BIN)/panelwright warm

test-packages:  # without the project itself, which runs beside this
	@$(BIN)/python -c 'import tomllib; extras = tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]; print(*extras["docs"], *extras["test"], sep="\n")' > .venv/test-packages.txt
	@$(call install,-r .venv/test-packages.txt)
	@$(BIN)/python -c 'import hypothesis, playwright, pytest, schemathesis' || { echo "error: the test packages are not complete; the lines above say why"; exit 2; }

demo: setup  ## Run the whole mission on the simulated cell and leave a report in runs/
	@$(BIN)/panelwright demo

serve: setup  ## Start the service on http://127.0.0.1:8460
	@$(BIN)/panelwright serve

test: setup  ## Run all tests, four files at a time; PYTEST_OPTIONS go to pytest
	@$(BIN)/python -m pytest --numprocesses 4 --dist loadscope --no-loadscope-reorder $(PYTEST_OPTIONS)

test-wire: setup  ## Run only the missions over emulated wires
	@$(BIN)/python -m pytest -m wire

test-fast: setup  ## Run the tests without missions, browsers and scaffolds
	@$(BIN)/python -m pytest --numprocesses 4 --dist loadscope --no-loadscope-reorder -m 'not slow and not wire'

test-planted: setup  ## Plant each defect of tests/planted and show that a test fails (nightly: ten minutes)
	@$(BIN)/python -m tests.planted $(PLANTED)

lint: setup  ## Style, types, layering and security, side by side
	@$(MAKE) --no-print-directory -j 3 --output-sync=target lint-style lint-types lint-layers lint-security

lint-style:
	@$(BIN)/ruff check . && $(BIN)/ruff format --check .

lint-types:
	@$(BIN)/mypy

lint-layers:
	@$(BIN)/lint-imports

lint-security:
	@$(BIN)/bandit --quiet --recursive --configfile pyproject.toml $(PRODUCT) && echo "bandit: nothing found"

hashes:  # writes hashes.txt anew, after a change of constraints.txt
	@{ sed -n 1p hashes.txt; $(BIN)/uv pip compile --quiet --no-deps --generate-hashes --no-header --no-annotate --python-version 3.11 constraints.txt; } \
	    > .venv/hashes.txt && mv .venv/hashes.txt hashes.txt

sbom: setup  ## Write build/sbom.json, the parts of this installation (CycloneDX)
	@mkdir -p build && $(BIN)/uv tool run --quiet --from cyclonedx-bom==7.5.0 cyclonedx-py environment --pyproject pyproject.toml \
	    --output-reproducible --output-file build/sbom.json $(BIN)/python && echo "sbom: build/sbom.json"

docs: setup  ## Build the pages into site/, with search
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet && echo "docs: open site/index.html"

pictures: setup  ## Take the pictures of the console in docs/ again (ten minutes)
	@$(BIN)/python -m tests.docs.console_pictures

format: setup  ## Put the code into shape
	@$(BIN)/ruff format . && $(BIN)/ruff check --fix .

bench-cables: setup  ## Read the simulated panel behind cables
	@$(BIN)/python -m benchmarks.behind_cables

bench-cell bench-missions bench-fusion bench-pose bench-range bench-vision bench-drivers: bench-%: setup  ## Measure, pass line beside figure
	@$(BIN)/python -m benchmarks.$*

clean:  ## Remove what was made
	rm -rf .venv build runs site *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
