# Everything happens in .venv, which `make setup` fills. P2P_PYTHON, P2P_TORCH: see tools/bootstrap.py.
PYTHON ?= python3
# One thread: the matrices are small, more cost time, and results agree between machines. `make THREADS=8 figures` overrides.
THREADS ?= 1
export OMP_NUM_THREADS := $(THREADS)
export OPENBLAS_NUM_THREADS := $(THREADS)
export MKL_NUM_THREADS := $(THREADS)
# ROS and others put packages of another Python there; and where Python may keep no bytecode, as in many containers,
# every process compiles its packages anew, which takes half of a short one's time.
unexport PYTHONPATH PYTHONHOME PYTHONDONTWRITEBYTECODE

.PHONY: help setup reproduce book test release test-backends test-ros docs mutants seeds bench lab figures lock
help: ## this list
	@grep -E '^[a-z-]+:.*## ' Makefile | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 22

setup: ## set up .venv (about a minute the first time, instant when nothing has changed)
	@$(PYTHON) tools/bootstrap.py

reproduce: setup ## run every notebook on bundled data into out/quick (profile quick: CPU, no downloads)
	@.venv/bin/p2p notebooks --profile quick --jobs 2

book: docs ## notebooks as make reproduce left them, and the API reference, as one site to read: out/book/index.html
	@test -f out/quick/index.html || $(MAKE) reproduce
	@rm -rf out/book && mkdir -p out/book/notebooks
	@cp out/quick/index.html out/book && cp out/quick/notebooks/*.html out/book/notebooks && cp -r out/docs out/book/api
	@rm -r out/book/api/notebooks && sed -i -E 's|href="((\.\./)*)notebooks/|href="\1../notebooks/|g' $$(find out/book/api -name '*.html')
	@sed -i 's|</h1>|</h1><p><a href="api/index.html">API reference</a></p>|' out/book/index.html
	@echo "Open out/book/index.html"

figures: setup ## every table and figure of the paper from the data and backends present; goes on where it was stopped
	-@.venv/bin/p2p benchmark --present --out out/benchmark --tables out/full/tables
	@.venv/bin/p2p notebooks --profile full --jobs 2
	@.venv/bin/p2p figures

test: setup ## linter and types, then all tests, every notebook included, and the API reference
	@.venv/bin/ruff check .
	@.venv/bin/ruff format --check .
	@# Types on one core; the API reference, and what would be compiled once in each test process, on the other.
	@.venv/bin/mypy & types=$$!; \
	    .venv/bin/python tools/docs.py && .venv/bin/python -c "import p2p_lib; p2p_lib.warm_up()"; rest=$$?; \
	    wait $$types && exit $$rest
	@.venv/bin/python -m pytest --numprocesses=2 --dist=loadfile --durations=5

docs: setup ## the API reference from the docstrings, pages that work offline, into out/docs
	@.venv/bin/python tools/docs.py

release: setup ## wheel and sdist into out/release, installed and tried; publishing up to the upload
	@.venv/bin/python tools/release.py

test-backends: setup ## the adapters of third-party networks against the official classes, in .venv-backends (no weights)
	@.venv/bin/python tools/test_backends.py

test-ros: setup ## the package for ROS 2 on a real ROS, in .venv-ros (needs cmake and g++)
	@.venv/bin/python tools/test_ros.py

seeds: setup ## run every notebook on seeds 1 to 4 (an hour and more)
	@P2P_SEEDS=1,2,3,4 .venv/bin/python -m pytest -q tests/apps/test_notebooks.py -k other_seeds

mutants: setup ## switch every mechanism off in turn and see its test fail (minutes)
	@.venv/bin/python tools/mutants.py

bench: setup ## what it costs as it grows, beside its peers, into benchmarks/README.md (ten minutes on two quiet cores)
	@.venv/bin/python benchmarks/scale.py

lab: setup ## open JupyterLab on the notebooks
	@P2P_FIGURES="$(CURDIR)/out/lab/figures" .venv/bin/jupyter lab $(if $(filter 0,$(shell id -u)),--allow-root) --log-level=WARN --notebook-dir=. notebooks/00_quickstart.ipynb

lock: setup ## resolve requirements.lock anew from pyproject.toml and pins.txt, and constraints.txt (no host in them)
	@.venv/bin/uv pip compile --quiet --upgrade --universal --python-version 3.11 --extra dev --generate-hashes \
	    --no-emit-package p2p-lib --no-emit-index-url --no-annotate --no-header --output-file .venv/resolved \
	    pyproject.toml pins.txt
	@# What torch's CUDA build needs is pinned by torch itself, and its CPU build does without.
	@awk '/^[^ ]/ { keep = !/^(nvidia-|cuda-|triton)/ } keep' .venv/resolved > requirements.lock
	@sed -n 's/ \\$$//; /^[^ ]/p' requirements.lock > constraints.txt
