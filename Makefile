# Every target sets up what it needs. PYTHON= chooses the interpreter, ARGS= adds to a command.

VENV := .venv

# Without PYTHON=: what a finished .venv was made with, else the first interpreter that will do.
ifndef PYTHON
PYTHON := $(shell for p in $(if $(wildcard $(VENV)/.installed-*),$(VENV)/bin/python) python3.11 python3.12 python3.13 python3; do \
	"$$p" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null \
	&& echo "$$p" && exit; done; echo python3)
endif
VERSION := $(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)
# Named after the version, so that another PYTHON= makes another environment.
STAMP := $(VENV)/.installed-$(or $(VERSION),none)

.DEFAULT_GOAL := help
.PHONY: help install test train lint

help: ## list the targets
	@sed -n 's/^\([a-z]*\):[^#]*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 10
	@echo 'PYTHON=python3.12 chooses the interpreter (3.11 to 3.13); ARGS="..." is added to the command,'
	@echo 'as in: make train ARGS="--seed=1"   make test ARGS="tests/replay_test.py"'

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

test: install ## run all tests
	@$(VENV)/bin/python -m pytest -q $(ARGS)

train: install ## train on Pong for about five minutes (two cores), into a new directory under runs/
	@$(VENV)/bin/python -m experiments.train --preset=demo \
		--out=runs/demo-$$(date +%Y%m%d-%H%M%S) $(ARGS)

lint: install ## check style and formatting
	@$(VENV)/bin/python -m ruff check . && $(VENV)/bin/python -m ruff format --check .
