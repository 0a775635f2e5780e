# The commands of development. `make help` lists them. Nothing here needs root.

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip --disable-pip-version-check --quiet

# What the installed package is made of. Folders are in the list so that a deleted file counts too.
SOURCES := api.py pyproject.toml README.md LICENSE NOTICE $(shell find spec model generators conformance \
  -name __pycache__ -prune -o \
  \( -type d -o -name '*.py' -o -name '*.ecs' -o -name '*.lark' -o -name '*.h' -o -name '*.html' \
  -o -name '*.css' -o -name '*.js' -o -name '*.json' -o -name py.typed \) -print)

# Tests of each package that take little: the language and the laws, the oracle, cases, reports.
QUICK := $(addprefix tests/test_,laws.py language.py esc.py oracle.py strings.py snapshot_session.py golden.py reports.py)

.PHONY: help demo test quick lint format docs chip site mutants bench clean
.DEFAULT_GOAL := help

help:  ## list the targets
	@sed -n 's/^\([a-z]*\):.*  ## /\1\t/p' Makefile | expand -t 10

demo: $(VENV)/installed  ## judge a virtual drive (conforms) and a foreign SDO server (does not)
	@echo '== 1 of 2: the virtual SubDevice against the text of the Kollmorgen AKD.'
	@echo '==         It is made from that text, so it must conform: exit status 0.'
	@echo '==         Both runs are quick ones, with one entry of each kind; leave out --depth quick for all.'
	$(BIN)/ecatspec run kollmorgen-akd --depth quick
	@echo
	@echo '== 2 of 2: the SDO server of the Python package canopen against the same text.'
	@echo '==         It was written for CAN, not for this drive: findings and exit status 1 are expected.'
	@echo '$(BIN)/ecatspec run kollmorgen-akd --dut canopen --depth quick'; \
	status=0; $(BIN)/ecatspec run kollmorgen-akd --dut canopen --depth quick || status=$$?; \
	if [ $$status -eq 1 ]; then echo '== demo done: statuses 0 and 1, as expected.'; \
	else echo "== demo failed: the second run ended with status $$status, expected was 1." >&2; exit 1; fi

test: lint  ## everything: lint, types, and the tests against the installed wheel
	$(BIN)/python -m pytest -n auto --dist loadgroup

quick: lint  ## the inner loop, under a minute: lint, and the tests of the language and of the laws
	$(BIN)/python -m pytest -q -n auto --dist loadgroup $(QUICK)

lint: $(VENV)/developed  ## formatting, rules, types, and what nothing uses
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/mypy tests bench docs examples
	$(BIN)/vulture

format: $(VENV)/developed  ## format the code and repair what can be repaired
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

docs: $(VENV)/installed  ## write the chapters and tables under docs/ anew (some minutes)
	$(BIN)/python docs/generate.py

chip: $(VENV)/installed  ## write the numbers of ecatspec_chip.h anew, after a change of the texts
	$(BIN)/python -m ecatspec.conformance.adapters.chip_header conformance/adapters/ecatspec_chip.h

site: $(VENV)/developed  ## build the documentation as HTML in site/, without a network
	$(BIN)/python -m sphinx -q -W -j auto -c docs . site
	@echo 'open site/index.html'

mutants: $(VENV)/installed  ## measure what the suites kill, and write docs/mutants.md (hours)
	$(BIN)/python docs/mutants.py

bench: $(VENV)/measured  ## measure, beside rivals (half an hour); BENCH=--write fills docs/performance.md
	$(BIN)/python bench/run.py $(BENCH)

clean:  ## remove everything made here
	rm -rf $(VENV) build dist site ecatspec.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo 'ecatspec needs Python 3.11 or newer; say which one: make PYTHON=python3.12 ...' >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

# pip builds a wheel of the folder and installs that wheel. The leftovers of an earlier build go
# first: setuptools would pack files again that the tree has no more.
$(VENV)/installed: $(VENV)/created $(SOURCES)
	@rm -rf build ecatspec.egg-info
	$(PIP) install '.[canopen]'
	@rm -rf build ecatspec.egg-info
	@touch $@

# `--group` needs pip 25.1, which many Pythons do not bring.
$(VENV)/developed: $(VENV)/installed pyproject.toml
	$(PIP) install --upgrade 'pip>=25.1'
	$(PIP) install --group dev --group docs
	@touch $@

$(VENV)/measured: $(VENV)/installed pyproject.toml
	$(PIP) install --upgrade 'pip>=25.1'
	$(PIP) install --group bench
	@touch $@
