# Two commands do all the set-up on a fresh machine with Python 3.11: make demo, make test.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PART ?= 1/1
# as many workers as cores, one thread each; the tests of a file share what they have made
PYTEST := OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n auto --dist loadfile

.PHONY: demo test test-long lint papers bench clean

$(STAMP): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $(STAMP)

demo: $(STAMP)
	rm -rf demo
	$(BIN)/magtensor simulate recipes/scenarios/undeclared_temperature.yaml --output demo/survey.h5
	$(BIN)/magtensor simulate recipes/scenarios/undeclared_temperature_verify.yaml --output demo/verify.h5
	$(BIN)/magtensor run recipes/closed_loop.yaml --input demo/survey.h5 --verify demo/verify.h5 --output demo/result

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/mypy
	MYPYPATH=pipeline:plugins:studies:benchmarks:tests/joint $(BIN)/mypy --follow-imports=silent studies benchmarks
	$(BIN)/lint-imports

test: lint
	$(PYTEST)

test-long: $(STAMP)
	$(PYTEST) -m long --part $(PART)  # those that `make test` leaves out; PART=2/12: the second of twelve parts

bench: $(STAMP)
	$(BIN)/python benchmarks/pipeline.py

papers: $(STAMP)
	$(BIN)/python studies/papers.py

clean:
	rm -rf $(VENV) demo
