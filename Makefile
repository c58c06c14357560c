# Every target sets up what it needs. PYTHON= chooses the interpreter, ARGS= adds to a command.

VENV := .venv
BENCH_VENV := .venv-bench
BENCH_PYTHON ?= python3.11
BENCH_CONSTRAINTS := experiments/benchmarks/constraints.txt

# Without PYTHON=: what a finished .venv was made with, else the first interpreter that will do.
ifndef PYTHON
PYTHON := $(shell for p in $(if $(wildcard $(VENV)/.installed-*),$(VENV)/bin/python) python3.11 python3.12 python3.13 python3; do \
	"$$p" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null \
	&& echo "$$p" && exit; done; echo python3)
endif
VERSION := $(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)
# Named after the version, so that another PYTHON= makes another environment.
STAMP := $(VENV)/.installed-$(or $(VERSION),none)

# A flag and its value, unless ARGS gives that flag: none may be given twice.
unless = $(if $(findstring $(1),$(ARGS)),,$(1)$(2))

# Tests that start few processes and compile little, half a minute in all.
FAST := augment config data/data diagnostics/measures envs/base experiments/arms \
	experiments/command_line/control_groups experiments/command_line/help experiments/compare \
	experiments/drawing/colours experiments/drawing/plots experiments/protocols \
	experiments/runs/run_data experiments/sweeping/plan experiments/sweeping/status files/metrics \
	files/reading files/rundir learning/optim project/api_docs project/docs replay/machine replay/replay \
	replay/sumtree rl/losses run/actor run/ending specs statistics/curves statistics/statistics window

.DEFAULT_GOAL := help
.PHONY: help install check test train lint docs soak bench bench-gpu bench-install answers

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):[^#]*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 15
	@echo 'PYTHON=python3.12 chooses the interpreter (3.11 to 3.13); ARGS="..." is added to the command,'
	@echo 'as in: make train ARGS="--seed=1"   make test ARGS="tests/replay/replay_test.py"'

install: $(STAMP) ## make .venv with everything that the other targets need

$(STAMP): pyproject.toml constraints.txt
	$(if $(filter 3.11 3.12 3.13,$(VERSION)),,$(error \
	$(PYTHON) is $(if $(VERSION),Python $(VERSION),not a Python that runs); \
	choose one from 3.11 to 3.13 with PYTHON=))
	@if ! $(VENV)/bin/python -c 'import pip, sys; sys.exit("%d.%d" % sys.version_info[:2] != "$(VERSION)")' \
	2>/dev/null; then \
		echo 'Making $(VENV) with Python $(VERSION)'; $(PYTHON) -m venv --clear $(VENV); fi
	@echo 'Installing the pinned dependencies into $(VENV) (a few minutes the first time)'
	@$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check \
		-c constraints.txt -e '.[dev,tensorboard]'
	@rm -f $(VENV)/.installed-* && touch $@

check: lint ## check style, types and what is tested fast (under a minute)
	@$(VENV)/bin/python -m mypy && $(VENV)/bin/python -m pytest -q $(FAST:%=tests/%_test.py) $(ARGS)

test: install ## run all tests, a file at a time in each of two processes
	@$(VENV)/bin/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder $(ARGS)

train: install ## train on Pong for about three minutes (two cores), into a new directory under runs/
	@$(VENV)/bin/python -m experiments.train $(call unless,--preset=,demo) \
		$(call unless,--out=,runs/demo-$$(date +%Y%m%d-%H%M%S)) $(ARGS)

docs: install ## write the API reference, build/docs/index.html
	@$(VENV)/bin/python docs/api.py build/docs && echo build/docs/index.html

lint: install ## check style and formatting
	@$(VENV)/bin/python -m ruff check . && $(VENV)/bin/python -m ruff format --check .

answers: install ## draw every figure and compute every number of docs/answers.md again (twelve minutes)
	@$(VENV)/bin/python -m experiments.analyses.answers $(ARGS)

soak: install ## try to break what is promised about killed runs, disks, inputs and combinations (2.5 hours)
	@$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[soak]'
	@$(VENV)/bin/python -m pytest $(if $(findstring tests/soak,$(ARGS)),,tests/soak) $(ARGS)

bench: install ## time this project beside PyTorch and Tianshou, and print a table (11 minutes)
	@$(VENV)/bin/python -m experiments.benchmarks.bench $(ARGS)

bench-gpu: install ## time updates, seeds and a whole run on an accelerator (needs the extra cuda12 or cuda13)
	@$(VENV)/bin/python -m experiments.benchmarks.gpu $(ARGS)

bench-install: $(BENCH_VENV)/.installed ## make .venv-bench with PyTorch and Tianshou, which bench compares with (1.6 GB)

# The extra alone, without jax and whatever else this project needs. On Linux a package index may give PyTorch
# with its GPU libraries, several GB: PIP_INDEX_URL or PIP_FIND_LINKS can point pip at a CPU build.
$(BENCH_VENV)/.installed: pyproject.toml $(BENCH_CONSTRAINTS)
	@if ! $(BENCH_VENV)/bin/python -c 'import pip, sys; sys.exit(sys.version_info[:2] != (3, 11))' \
	2>/dev/null; then \
		$(BENCH_PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null \
		|| { echo '$(BENCH_PYTHON) is not Python 3.11; choose one with BENCH_PYTHON=' >&2; exit 1; }; \
		echo 'Making $(BENCH_VENV)'; $(BENCH_PYTHON) -m venv --clear $(BENCH_VENV); fi
	@echo 'Installing PyTorch and Tianshou into $(BENCH_VENV) (a few minutes the first time)'
	@$(BENCH_VENV)/bin/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"] \
		["optional-dependencies"]["bench"], sep="\n")' > $(BENCH_VENV)/requirements.txt
	@$(BENCH_VENV)/bin/python -m pip install --quiet --disable-pip-version-check \
		-c $(BENCH_CONSTRAINTS) -r $(BENCH_VENV)/requirements.txt
	@touch $@
