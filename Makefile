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

.PHONY: help setup build test test-camera camera demo deb test-deb lint bench fuzz soak evaluate evaluate-saliency python clean

help: ## what the targets do
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 20

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
test: ## all tests: cargo's, then pytest's, in a browser, too, then those with a fake camera
	@scripts/setup.sh test
	cargo test --locked --workspace --exclude samsod-python --exclude samsod-benches
	$(MAKE) --no-print-directory python
	cd $(PYTHON_CRATE) && ../../$(VENV)/python -m pytest
	@if [[ $$EUID -eq 0 ]] || { pkg-config --exists aravis-0.8 libusb-1.0 && command -v arv-fake-gv-camera-0.8; } >/dev/null 2>&1; then \
	    $(MAKE) --no-print-directory test-camera; \
	else echo "Aravis is not installed: samsod-camera was not tested (make test-camera says what to install)"; fi

# A workspace of its own, because it needs libaravis.
CAMERA := --locked --manifest-path crates/camera-client/Cargo.toml --target-dir "$${CARGO_TARGET_DIR:-target}"

camera: ## target/release/samsod-camera: GigE Vision, USB3 Vision and V4L2 cameras; installs libaravis-dev
	@scripts/setup.sh camera
	cargo build --release --all-features $(CAMERA)

test-camera: ## the tests of samsod-camera, with Aravis' fake GigE camera on loopback
	@scripts/setup.sh camera
	cargo test --all-features $(CAMERA)

lint: ## formatting, clippy, documentation, types and shell scripts; warnings are errors
	@scripts/setup.sh lint
	cargo fmt --all --check
	cargo clippy --locked --workspace --all-targets -- -D warnings
	cargo fmt --manifest-path crates/camera-client/Cargo.toml --check
	@if pkg-config --exists aravis-0.8 libusb-1.0 2>/dev/null; then \
	    cargo clippy --all-targets --all-features $(CAMERA) -- -D warnings && \
	    RUSTDOCFLAGS="-D warnings" cargo doc --all-features --lib --no-deps --quiet $(CAMERA); \
	else echo "libaravis-dev and libusb-1.0-0-dev are not installed: samsod-camera was not checked"; fi
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

fuzz: ## [SECONDS=60]: fuzz what reads bytes of others: network, frames, recordings; needs a nightly compiler
	@scripts/setup.sh
	scripts/fuzz.sh $(SECONDS)

# In release, as the service runs; the short one that `make test` runs is in the dev profile.
soak: ## [SECONDS=3600] [RESTARTS=500]: samsodd at 22 frames a second, then restarts by SIGKILL; the last line is the result
	@scripts/setup.sh
	@SAMSOD_SOAK_SECONDS=$(or $(SECONDS),3600) SAMSOD_SOAK_RESTARTS=$(or $(RESTARTS),500) \
	    cargo test --release --locked --quiet -p samsod-daemon --test soak

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

# make hands DATA, OUT and SIZE to the script in its environment.
evaluate-saliency: ## DATA=DIR OUT=DIR [SIZE=PX]: saliency on images/ and masks/ of DATA (and maps/METHOD/), or of its folders
	@scripts/setup.sh peers
	@$(MAKE) --no-print-directory python
	scripts/evaluate-saliency.sh "$$DATA" "$$OUT"

clean: ## remove what was built, installed here and written by the demo
	rm -rf target .venv demo-output $(PYTHON_CRATE)/python/samsod/*.so
