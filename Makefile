# Each target sets up all it needs in .venv; only Python 3.11+, make and a compiler have to be there.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready

.PHONY: check demo test lint docs site figures paper paper-full bench mutants damage clean

demo: $(READY)
	$(BIN)/vlcrender generate datasets/quickstart.toml --out out/quickstart
	$(BIN)/estimator run out/quickstart
	$(BIN)/estimator score out/quickstart
	$(BIN)/estimator report out/quickstart --out out/quickstart/report.html

test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile

check: lint
	$(BIN)/python -m pytest -m "not slow"

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/oxlint --deny-warnings estimator/report
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(READY)
	$(BIN)/python docs/make_reference.py
	$(BIN)/python docs/make_api.py
	$(BIN)/python docs/make_notebooks.py
	$(BIN)/python docs/make_variants.py
	$(BIN)/python docs/make_tutorial.py

# out/site/index.html; a warning is an error. tests/test_site.py builds it too, and checks its links.
site: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build

figures: $(READY)
	$(BIN)/python docs/measure.py
	$(BIN)/python docs/measure_belief.py
	$(BIN)/python docs/measure_budget.py
	$(BIN)/python docs/measure_downlink.py

# docs/paper.md: sets of minutes, or with the paper's sizes (hours; a run with --minutes goes on where it stopped).
paper: $(READY)
	$(BIN)/python docs/make_paper.py

paper-full: $(READY)
	$(BIN)/python docs/make_paper.py --full

# All of them run; it fails at the end where one falls short.
BENCHMARKS := full_frame cycles options workers errors memory growth plan sweep denoise shards
bench: $(READY)
	$(BIN)/vlcrender generate datasets/office20.toml --out out/bench/full --set poses.count=8 --set bound=false
	$(BIN)/vlcrender generate datasets/office200.toml --out out/bench/regions --set poses.count=60 --set bound=false
	$(BIN)/vlcrender generate datasets/table1.toml --out out/bench/four --set poses.columns=8 --set poses.rows=8
	@missed=; \
	for one in $(BENCHMARKS); do \
		echo "== benchmarks/$$one.py"; $(BIN)/python benchmarks/$$one.py || missed="$$missed $$one"; \
	done; \
	echo "== benchmarks/estimators.py"; \
	$(BIN)/python benchmarks/estimators.py out/bench/regions out/bench/full out/bench/four || missed="$$missed estimators"; \
	test -z "$$missed" || { echo "falls short:$$missed" >&2; exit 1; }

$(READY): requirements.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "vlcrender needs Python 3.11 or newer: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes --requirement requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	touch $@

# Not in CI: the map takes about ten minutes, each mutant a few seconds to minutes; runs go on where they stopped.
mutants: $(READY)
	test -f out/mutants/branches.sqlite || $(BIN)/python tests/mutation/run.py map
	$(BIN)/python tests/mutation/run.py chosen
	$(BIN)/python tests/mutation/run.py sample --count 150 --seed 7

# Not in CI: some minutes. Each prints what came of every flip or run, and exits with 1 where a set is lost or mixed.
damage: $(READY)
	$(BIN)/python tests/damage/flips.py --finished 2000 --unfinished 500
	$(BIN)/python tests/damage/flips.py --finished 1000 --unfinished 200 --sharded
	$(BIN)/python tests/damage/kills.py --count 50
	$(BIN)/python tests/damage/races.py --count 20

clean:
	rm -rf .venv out
