VENV ?= .venv
PYTHON ?= python3
BIN := $(VENV)/bin

.PHONY: setup test check demo weights clean

setup: $(VENV)/.ready

# One virtual environment with everything the tests and tools need.
$(VENV)/.ready: pyproject.toml constraints.txt
	rm -rf build
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[dev]"
	mkdir -p .typing/idesplat
	for package in model export runtime tools; do ln -sfn ../../$$package .typing/idesplat/$$package; done
	touch $@

# Lint, types and tests.
test: check
	$(BIN)/python -m pytest --quiet

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy -p idesplat.model -p idesplat.export -p idesplat.runtime -p idesplat.tools

# Photographs of a drawn room to a splat, in demo/.
demo: setup
	$(BIN)/python -P -m idesplat.tools.demo demo

# The carried model, trained from nothing: five hours of one core. Stopped at any moment, it goes on where it was.
weights: setup
	$(BIN)/idesplat-train --out runs/tiny --steps 4000 --batch 1 --size 256 --seed 0
	$(BIN)/idesplat-train --out runs/finer --init runs/tiny/last.ckpt --no-gradual \
		--steps 1200 --lr 5e-4 --vit-lr 2e-4 --batch 1 --size 256 --seed 1
	$(BIN)/python -P -m idesplat.tools.carry runs/finer/last.ckpt

clean:
	rm -rf $(VENV) build .typing *.egg-info
