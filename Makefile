# Every target first runs scripts/setup.sh, which installs what is missing or says which command does.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

# rustup's cargo is not on the PATH of every shell.
export PATH := $(PATH):$(HOME)/.cargo/bin
export VIRTUAL_ENV := $(CURDIR)/.venv
# One interpreter for cargo and maturin: a change of it would compile the bindings anew.
export PYO3_PYTHON := $(CURDIR)/.venv/bin/python

VENV := .venv/bin
PYTHON_CRATE := crates/python

.PHONY: help setup build test demo deb test-deb lint bench fuzz evaluate python clean

help: ## what the targets do
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 16

setup:
	@scripts/setup.sh

python: setup
	$(VENV)/maturin develop --release --locked --manifest-path $(PYTHON_CRATE)/Cargo.toml

build: setup ## target/release/samsodd, target/release/samsod and .venv with the Python package
	cargo build --release --locked -p samsod-daemon
	$(MAKE) --no-print-directory python
	@echo "built: target/release/samsodd, target/release/samsod, and the package samsod in .venv"

# The tests run in the dev profile, which is optimised and keeps overflow checks and debug assertions. The extension
# module is installed in release, so that what `make build` left in .venv stays what it was.
test: ## all tests: cargo's, then pytest's, in a browser, too
	@scripts/setup.sh test
	cargo test --locked --workspace --exclude samsod-python --exclude samsod-benches
	$(MAKE) --no-print-directory python
	cd $(PYTHON_CRATE) && ../../$(VENV)/python -m pytest

lint: ## formatting, clippy, documentation, types and shell scripts; warnings are errors
	@scripts/setup.sh lint
	cargo fmt --all --check
	cargo clippy --locked --workspace --all-targets -- -D warnings
	@# Libraries only: the program samsod and the crate samsod would write to the same file.
	RUSTDOCFLAGS="-D warnings" cargo doc --locked --workspace --lib --no-deps --quiet
	cd $(PYTHON_CRATE) && ../../$(VENV)/ruff check . && ../../$(VENV)/ruff format --check . && ../../$(VENV)/mypy
	@if command -v shellcheck >/dev/null; then shellcheck scripts/*.sh .ci/run packaging/debian/* packaging/clients/* && echo "shellcheck: clean"; \
	else echo "shellcheck is not installed: the scripts were not checked"; fi
	@if command -v systemd-analyze >/dev/null; then scripts/verify-units.sh; \
	else echo "systemd-analyze is not installed: the units were not checked"; fi

# make hands CONTROLLER and PARTS to the script in its environment.
demo: build ## [CONTROLLER=motoman] samsodd clears a simulated table; ends with `placed 6 of 6, 0 collisions, ..`
	scripts/demo.sh $(SEED)

# What stands in target/release is what cargo-deb looks for, wherever cargo builds.
deb: ## a Debian package in target/debian: programs, systemd units, manual pages, completions
	@scripts/setup.sh deb
	cargo build --release --locked -p samsod-daemon
	"$${CARGO_TARGET_DIR:-target}/release/samsod" generate "$${CARGO_TARGET_DIR:-target}/release/deb"
	cargo deb --no-build --locked -p samsod-daemon
	@ls -l "$${CARGO_TARGET_DIR:-target}"/debian/samsod_*.deb

test-deb: deb ## install, run, upgrade and remove that package, as root in an overlay that is thrown away
	scripts/test-deb.sh "$$(ls -t "$${CARGO_TARGET_DIR:-target}"/debian/samsod_*.deb | head -n 1)"

bench: ## times of every stage and of the whole chain (criterion), then a table beside OpenCV and the bars
	@scripts/setup.sh
	cargo bench --locked -p samsod-benches --bench segment --bench saliency --bench regions --bench shadow \
	    --bench recognize --bench robot --bench chain
	cargo bench --locked -p samsod-benches --bench figures

fuzz: ## [SECONDS=60]: fuzz the parsers of what comes from the network; needs a nightly compiler
	@scripts/setup.sh
	scripts/fuzz.sh $(SECONDS)

# make hands DATA, OUT, LEAVE_OUT and CONVENTIONAL to the recipe in its environment, where no character of them needs
# quoting.
evaluate: ## DATA=DIR OUT=DIR [LEAVE_OUT="a,b"] [CONVENTIONAL=N|all]: measure on scenes with known truth; results in OUT
	@if [[ -z $${DATA:-} || -z $${OUT:-} ]]; then \
	    echo "make evaluate needs two folders: make evaluate DATA=DIR OUT=DIR" >&2; \
	    echo "  DATA          scenes with known truth (index.json, images/, masks/, shadows/, gt/), or the folder above" >&2; \
	    echo "                them; with templates/ and parts/ in it, beside or above, parts are recognised, too" >&2; \
	    echo "  OUT           where tables, histograms, summary.json and pictures are written" >&2; \
	    echo "  LEAVE_OUT     parts to take from the catalogue, \"a,b\": how many of them get a false name" >&2; \
	    echo "  CONVENTIONAL  the slow methods of comparison run on every Nth scene, on all or, 0, on none; default 6" >&2; \
	    exit 2; \
	elif [[ ! -d $$DATA ]]; then echo "DATA=$$DATA: no such folder" >&2; exit 2; fi
	@$(MAKE) --no-print-directory build
	$(VENV)/python -m samsod.evaluation cell "$$DATA" --out "$$OUT" --sheets 6 --samsod target/release/samsod \
	    $${LEAVE_OUT:+--leave-out "$$LEAVE_OUT"} $${CONVENTIONAL:+--conventional "$$CONVENTIONAL"}

clean: ## remove what was built, installed here and written by the demo
	rm -rf target .venv demo-output $(PYTHON_CRATE)/python/samsod/*.so
