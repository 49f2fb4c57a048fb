VENV ?= .venv
PYTHON ?= python3
BIN := $(VENV)/bin
# Processes of one thread each are faster than one of two threads: most tests are too small to share out. With two for
# each of two cores, a core has work while a test waits for a browser, for Ray or for a process that it started.
# Kept by malloc, large buffers save some 6 % of the processor's time.
KEEP := MALLOC_MMAP_THRESHOLD_=4294967296 MALLOC_TRIM_THRESHOLD_=4294967296
PYTEST := OMP_NUM_THREADS=1 $(KEEP) $(BIN)/python -m pytest --quiet -n 4 --dist loadfile --no-loadscope-reorder

# With compiled modules kept, hundreds of processes of the tests don't compile them again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup test pytest webgpu quick check docs demo web weights clean

setup: $(VENV)/.ready

# One virtual environment with everything the tests and tools need; with Node.js also the npm packages of some tests.
$(VENV)/.ready: pyproject.toml constraints.txt tests/npm/package-lock.json
	rm -rf build
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[dev]"
	if command -v npm > /dev/null; then \
		npm ci --prefix tests/npm --silent --no-audit --no-fund && \
		npm install --prefix docs/examples --silent --no-audit --no-fund --no-package-lock && \
		$(BIN)/python -P -m idesplat.runtime.web.third_party; fi
	mkdir -p .typing/idesplat
	for part in *.py py.typed model export runtime tools; do ln -sfn ../../$$part .typing/idesplat/$$part; done
	touch $@

# Lint, types and every test but that of `make webgpu`. Types are checked beside the tests, which do not keep two cores
# busy all the time.
test: setup
	$(MAKE) --no-print-directory --jobs 2 check pytest

pytest: setup
	$(PYTEST) -m "not webgpu"

# Whole networks on a WebGPU adapter in software: some ten minutes.
webgpu: setup
	$(PYTEST) -m webgpu

# For the edit loop: the tests that take less than a second each.
quick: setup
	$(PYTEST) -m "not slow and not browser and not network and not webgpu"

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy -p idesplat

# The documentation, in site/; every warning is an error.
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --site-dir site

# Images of a synthetic room to a splat, in demo/.
demo: setup
	$(BIN)/python -P -m idesplat.tools.figures.demo demo

# The npm files of the page of `idesplat web`, pinned in runtime/web/third_party.json; a wheel built afterwards holds them.
web: setup
	$(BIN)/python -P -m idesplat.runtime.web.third_party

# Photographs under free licences (MODEL_CARD.md) for the textures of training scenes; it needs Debian's apt and git.
TEXTURES := gnome-backgrounds mate-backgrounds plasma-workspace-wallpapers
runs/textures:
	mkdir -p runs/textures.part
	cd runs/textures.part && apt-get download $(TEXTURES) && for package in *.deb; do dpkg-deb -x $$package .; done
	git clone --quiet --depth 1 https://github.com/pmndrs/drei-assets runs/drei-assets
	cp -r runs/drei-assets/hdri runs/textures.part/
	find runs/textures.part \( -type l -o -size -60k -o -name '*.deb' \) ! -type d -delete
	mv runs/textures.part runs/textures

# A model like the bundled one, trained from nothing: depth, then the head on that depth, then all parts, in two runs. Each
# command resumes where it was stopped. The first is that of a GPU, where DEPTH_ON="--device cuda --threads 4 --together
# 24 --loaders 8" takes some 15 minutes (MODEL_CARD.md, which also tells how the bundled weights were made).
DEPTH_ON := --processes 2
LITE := $(BIN)/idesplat train --preset idesplat-lite --textures runs/textures --size 256
weights: setup runs/textures
	$(LITE) --out runs/depth --objective depth --steps 1700 --batch 24 --lr 1e-3 --photo-lr 6e-5 --seed 151 $(DEPTH_ON)
	$(LITE) --out runs/head --train head --init runs/depth/last.ckpt --scenes 320 --steps 1000 --batch 2 --lr 1e-3 \
		--perceptual none --processes 2 --precision bf16 --seed 152
	$(LITE) --out runs/all --init runs/head/last.ckpt --no-curriculum --steps 300 --batch 2 --lr 3e-4 --perceptual lite0 \
		--consistency 0.01 --processes 2 --precision bf16 --seed 153
	$(LITE) --out runs/longer --init runs/all/last.ckpt --no-curriculum --steps 1000 --batch 2 --lr 3e-4 --perceptual lite0 \
		--consistency 0.01 --processes 2 --precision bf16 --seed 161
	$(BIN)/idesplat export runs/longer/last.ckpt runs/idesplat-lite.onnx --preset idesplat-lite --overwrite

clean:
	rm -rf $(VENV) build site .typing tests/npm/node_modules docs/examples/node_modules runtime/web/vendor *.egg-info
