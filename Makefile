# Everything runs inside .venv, which is set up on first use and again when the packages asked for have changed.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
USABLE := .venv/.usable

export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Images of containers often set this; each of hundreds of processes of the tests would then compile our files anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: league setup check style types test quick test-slow slow optimised test-gpu site clean

league: $(if $(wildcard $(STAMP)),$(STAMP),$(USABLE))  ## Set up what running needs, run a small league, film its last match.
	$(BIN)/league run --preset quickstart --live
	$(BIN)/league watch --video quickstart-$$(date +%H%M%S).webp --seconds 12

setup: $(STAMP)  ## Create .venv with all that running, watching and testing need.

check: style types  ## Format, lint, layers, types.

style: $(STAMP)
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/lint-imports

types: $(STAMP)
	$(BIN)/pyright

# Most of these tests compile programs that they run once. On a CPU XLA compiles in a fifth of the time where it
# optimises little; jax 0.10.2 knows the flag of XLA. Tests marked `optimised` undo the first of the two.
UNOPTIMISED := JAX_DISABLE_MOST_OPTIMIZATIONS=1 XLA_FLAGS="$(XLA_FLAGS) --xla_cpu_use_fusion_emitters=false"
QUICKLY = $(if $(shell nvidia-smi -L 2>/dev/null),,$(UNOPTIMISED))

test: style  ## What must pass before a change is shared. Types, a minute of one core, are checked beside the first tests.
	$(MAKE) --no-print-directory --jobs 2 types quick

# Tests wait for processes and servers an eighth of their time, so three at once keep two cores busy.
quick: $(STAMP)
	$(QUICKLY) $(BIN)/pytest -rs -m "not slow and not gpu" -n 3 --dist loadfile --no-loadscope-reorder

# Only files with such tests are collected, which saves each process seconds; tests/conftest.py refuses a mark that does
# not stand in a test's file.
WITH = $$(grep -rl --include='test_*.py' 'mark\.$(1)' tests | sort)

test-slow: $(STAMP)  ## What takes longer: arenas on the engines that take minutes to compile, and whole leagues.
	$(MAKE) --no-print-directory --jobs 2 slow optimised

# Leagues wait for each other's processes: three of these tests keep two cores busy, and the few tests that need other
# flags run beside the first of them.
slow: $(STAMP)
	$(QUICKLY) $(BIN)/pytest -rs -m "slow and not optimised and not gpu" -n 3 --dist worksteal $(call WITH,slow)

optimised: $(STAMP)
	$(BIN)/pytest -rs -m "slow and optimised and not gpu" $(call WITH,optimised)

test-gpu: $(STAMP)  ## On a machine with an NVIDIA GPU: all arenas and variants on the engines and kernels of GPUs.
	$(BIN)/pytest -rs -v -m gpu

# Not with --quiet: mkdocs would then count no warning as an error.
site: $(STAMP)  ## The pages as a site in build/site; for its search, serve it: python3 -m http.server -d build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

clean:  ## Remove what make and the tools wrote; leagues stay.
	rm -rf .venv build dist *.egg-info .pytest_cache .ruff_cache .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(STAMP) $(USABLE): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null || { \
		echo "Robot League needs Python 3.11, 3.12 or 3.13, and $(PYTHON) is not one: name it, as in make PYTHON=python3.12 $(MAKECMDGOALS)"; \
		exit 1; }
	test -x $(BIN)/pip || $(PYTHON) -m venv .venv
	extras=view,video,dash; if [ $@ = $(STAMP) ]; then extras=$$extras,foxglove,envs,dev; fi; if nvidia-smi -L >/dev/null 2>&1; then extras=$$extras,cuda; fi; \
		$(BIN)/python -m pip install -c constraints.txt -e ".[$$extras]"
	@touch $@
