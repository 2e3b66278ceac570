# The two commands of the README are `make replay` and `make test`; each sets up all it needs.
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin
EXTRAS ?=
EMPTY :=
STAMP := $(VENV)/.synced$(subst $(EMPTY) $(EMPTY),,$(addprefix -,$(EXTRAS)))
OUT ?= out/replay

export UV_PROJECT_ENVIRONMENT := $(VENV)
export UV_PYTHON_DOWNLOADS := never

.DEFAULT_GOAL := help
.PHONY: help setup replay test test-all check format bench proto clean

help: ## Show what can be made
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 12

setup: $(STAMP) ## Set up the environment in .venv, exact versions from uv.lock

# uv comes from the PATH, or by pip into an environment of its own.
$(STAMP): pyproject.toml uv.lock
	@uv=$$(command -v uv || true); \
	if [ -z "$$uv" ]; then \
	  [ -x .uv/bin/uv ] || { echo "setup: fetching uv"; $(PYTHON) -m venv .uv && .uv/bin/pip install --quiet uv; } || exit 1; \
	  uv=.uv/bin/uv; \
	fi; \
	echo "setup: $(VENV) from uv.lock"; \
	"$$uv" sync --quiet --frozen --compile-bytecode --python $(PYTHON) $(addprefix --extra ,$(EXTRAS))
	@echo "setup: compiling the detector" && $(RUN)/python -c "import astratag"
	@rm -f $(VENV)/.synced* && touch $@

replay: $(STAMP) ## Replay the shipped approach corridor, live in Rerun, and score it
	$(RUN)/relnav replay --out $(OUT) $(ARGS)

test: check ## Lint, type check and run the tests
	$(RUN)/pytest -q $(ARGS)

test-all: check ## The same with the slow tests
	$(RUN)/pytest -q -m "slow or not slow" $(ARGS)

check: $(STAMP) ## Run ruff, mypy and the import contracts
	$(RUN)/ruff check .
	$(RUN)/ruff format --check .
	$(RUN)/mypy
	$(RUN)/lint-imports --no-cache

format: $(STAMP) ## Format the code
	$(RUN)/ruff check --fix .
	$(RUN)/ruff format .

bench: $(STAMP) ## Run the benchmarks
	$(RUN)/python -m benchmarks.detection --images 10
	$(RUN)/python -m benchmarks.filter
	$(RUN)/python -m benchmarks.corridors
	$(RUN)/python -m benchmarks.throughput

proto: $(STAMP) ## Write the .proto files out again
	$(RUN)/python -m schemas.proto

clean: ## Remove the environments and all output
	rm -rf $(VENV) .uv out
